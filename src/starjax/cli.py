"""The console script `starjax`: one subcommand, one module, imported only when it is called."""

import errno
import importlib
import os
import sys
import warnings
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

from starjax import __version__, errors, extras
from starjax.runtime import signals

_LEARNING = ("sim", "train")
_ALL = (*_LEARNING, "report")
_EXCHANGE = (*_LEARNING, "formats")
# Subcommand -> (module with `main(argv) -> exit code`, or module:function, one line of help, extras
# that it needs).
COMMANDS: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "run": (
        "starjax.commands.run",
        "collect, train, evaluate and report: the whole of it",
        _ALL,
    ),
    "collect": ("starjax.commands.run:collect", "demonstrations only", _LEARNING),
    "train": (
        "starjax.commands.run:train",
        "demonstrations and training, no evaluation",
        _LEARNING,
    ),
    "evaluate": (
        "starjax.commands.evaluate",
        "score a trained policy on its task's trocars",
        _LEARNING,
    ),
    "sweep": (
        "starjax.commands.sweep",
        "score a trained policy on a grid or sample of trocars",
        _LEARNING,
    ),
    "stress": (
        "starjax.commands.stress",
        "score a trained policy while something is wrong",
        _LEARNING,
    ),
    "six-blocks": (
        "starjax.commands.six_blocks",
        "six blocks one after another with two arms, beside people's times",
        _LEARNING,
    ),
    "bench": ("starjax.commands.bench", "inference latency of a policy (Table IV)", _LEARNING),
    "serve": (
        "starjax.commands.serve",
        "a trained policy for robots elsewhere, over websockets",
        ("sim", "serve"),
    ),
    "pack": ("starjax.commands.pack", "a policy in a file of half the size", _LEARNING),
    "export": (
        "starjax.commands.export_command",
        "demonstrations as a LeRobot, robomimic or zarr dataset",
        _EXCHANGE,
    ),
    "import": (
        "starjax.commands.import_command",
        "a dataset from LeRobot, robomimic or zarr, to train on",
        _EXCHANGE,
    ),
    "inspect": (
        "starjax.commands.inspect_command",
        "what is in a dataset, policy or result, and what is odd about it",
        _EXCHANGE,
    ),
    "report": (
        "starjax.commands.report_command",
        "tables, figures, video, page from results",
        ("sim", "report"),
    ),
    "view": (
        "starjax.commands.view",
        "a policy, an expert or a dataset at work, live in a browser",
        (*_LEARNING, "viewer"),
    ),
    "teleop": (
        "starjax.commands.teleop",
        "demonstrate by hand in a browser; episodes become a dataset",
        (*_LEARNING, "viewer"),
    ),
    "list": ("starjax.commands.list_command", "what flags can name", ("sim",)),
    "find-mount": (
        "starjax.commands.find_mount",
        "search where an arm must stand for a task",
        ("sim", "train"),
    ),
    "doctor": (
        "starjax.doctor",
        "what of this machine and installation works, and what to do",
        ("sim",),
    ),
}

# Names of the previous release; dropped in the next.
_RENAMED = {"exercise": "six-blocks", "place": "find-mount"}
_WRITING = (errno.ENOSPC, errno.EROFS, errno.EDQUOT)
_STORAGE = (
    *_WRITING, errno.EACCES, errno.EPERM, errno.EISDIR, errno.ENOTDIR, errno.ENAMETOOLONG
)  # fmt: skip
_STOPPED = 130  # exit code after a stop, see `signals`
_BROKEN_PIPE = 141  # exit code if the output pipe is closed (128 + SIGPIPE), as by `| head`
_OURS = os.path.join(os.path.dirname(os.path.abspath(__file__)), "")
_with_its_place = warnings.formatwarning
_CACHE_ENTRY = "persistent compilation cache entry"  # in jax's warnings
_told: set[str] = set()  # warnings that are said once


def main() -> NoReturn:
    """Entry of the console script."""
    run(dispatch)


def run(command: Callable[[Sequence[str]], int]) -> NoReturn:
    """The whole of a process: `command` with the words of its command line."""
    # None for an output that was closed before the process began, as by `>&-`.
    sys.stdout = sys.stdout or open(os.devnull, "w")  # noqa: SIM115
    sys.stderr = sys.stderr or open(os.devnull, "w")  # noqa: SIM115
    sys.unraisablehook = _without_interrupts
    warnings.formatwarning = _warning
    signals.interrupt_on_stops()
    code = _STOPPED
    try:
        code = guard(command, sys.argv[1:])
        if code == _STOPPED:
            signals.ignore_stops()
    except KeyboardInterrupt:  # once more, between two lines of ours
        signals.ignore_stops()
    if code == _STOPPED:  # jax's threads may still run, and would meet an interpreter that is gone
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


def guard(command: Callable[[Sequence[str]], int], argv: Sequence[str]) -> int:
    """Runs a command; what its user can mend becomes one line and an exit code, no traceback.

    Returns 2 for a mistake on the command line, 71 for too little memory, 74 for a disk that is
    full or cannot be used, 130 after a stop such as Ctrl-C or SIGTERM (whatever was running has
    saved by then, and says how to go on), 141 once nobody reads the output.
    """
    try:
        return command(argv)
    except errors.UsageError as error:
        return _fail(_spelled(error), 2)
    except KeyboardInterrupt as stop:
        text = str(stop) or "stopped; the same command goes on from what is saved"
        return _fail(text, _STOPPED)
    except BrokenPipeError:
        # What Python still holds for the reader would fail again when the process ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _BROKEN_PIPE
    except OSError as error:
        # Imported late: it brings numpy, and `--help` need not wait for it.
        from starjax.runtime import files

        if isinstance(error, files.StorageError):
            return _fail(error, 74)
        if error.errno not in _STORAGE:
            raise
        place = f": {error.filename}" if error.filename else ""
        does = "write" if error.errno in _WRITING else "read or write"
        return _fail(f"cannot {does}{place}: {error.strerror}", 74)
    except MemoryError as error:
        return _fail(f"too little memory ({error or 'none left'}): close other programs", 71)
    except RuntimeError as error:
        if not str(error).startswith("RESOURCE_EXHAUSTED"):
            raise
        said = str(error).splitlines()[0].removeprefix("RESOURCE_EXHAUSTED: ")
        less = "in training lower --train.batch-size, for the rest start with JAX_PLATFORMS=cpu"
        return _fail(f"{said} Too much for this device's memory: {less}", 71)


def dispatch(argv: Sequence[str]) -> int:
    """Runs the subcommand that `argv` begins with."""
    name = argv[0] if argv else "--help"
    if name in ("-h", "--help"):
        width = max(map(len, COMMANDS))
        print("usage: starjax COMMAND [OPTIONS]      (starjax COMMAND --help for its options)\n")
        print("\n".join(f"  {name:{width}}  {text}" for name, (_, text, _) in COMMANDS.items()))
        return 0
    if name == "--version":
        print(__version__)
        return 0
    if name in _RENAMED:
        errors.warn_renamed(name, _RENAMED[name])
        name = _RENAMED[name]
    errors.choice("COMMAND", name, COMMANDS)
    module, _, needed = COMMANDS[name]
    extras.require(name, *needed)
    module, _, function = module.partition(":")
    return getattr(importlib.import_module(module), function or "main")(argv[1:])


def _without_interrupts(ignored: Any) -> None:
    """Says what Python dropped, but for a stop, which is raised again."""
    if ignored.exc_type is not KeyboardInterrupt:
        sys.__unraisablehook__(ignored)


def _warning(message: Warning | str, kind: type[Warning], place: str, *rest: Any) -> str:
    """Formats a warning: ours as one line, those of others with their place.

    jax warns of every program, hundreds of them, that its cache cannot keep or read: one line says
    so, once.
    """
    if os.path.abspath(place).startswith(_OURS):
        return f"starjax: {message}\n"
    what, found, why = str(message).partition(_CACHE_ENTRY)
    if not found:
        return _with_its_place(message, kind, place, *rest)
    if _CACHE_ENTRY in _told:
        return ""
    _told.add(_CACHE_ENTRY)
    reason = " ".join(why.partition(": ")[2].split())
    return (
        f"starjax: {what.strip().lower()} compiled programs: {reason}; the work goes on, and every "
        "start compiles them again (starjax doctor says more)\n"
    )


def _spelled(error: errors.UsageError) -> str:
    """A mistake's line, with flags instead of fields if tyro is there to read them."""
    try:
        from starjax.commands import options  # late: `--version` need not wait for tyro
    except ModuleNotFoundError:
        return str(error)
    return options.spelled(error)


def _fail(message: object, code: int) -> int:
    print(f"starjax: {message}", file=sys.stderr)
    return code
