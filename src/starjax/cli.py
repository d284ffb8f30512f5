"""The console script `starjax`: imports the module of the called subcommand only."""

import errno
import importlib
import os
import sys
import traceback
import warnings
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

from starjax import __version__, errors, extras
from starjax.runtime import signals

_LEARNING = ("sim", "train")
_ALL = (*_LEARNING, "report")
_EXCHANGE = (*_LEARNING, "formats")
_VIEWER = (*_LEARNING, "viewer")
# Subcommand -> (module with `main(argv) -> exit code`, or module:function; help; extras).
_TABLE: dict[str, tuple[str, str, tuple[str, ...]]] = {
    "run": ("commands.run", "run the full pipeline: collect, train, evaluate, report", _ALL),
    "collect": ("commands.run:collect", "collect demonstrations only", _LEARNING),
    "train": ("commands.run:train", "collect demonstrations and train", _LEARNING),
    "evaluate": ("commands.evaluate", "evaluate a policy on its task's trocars", _LEARNING),
    "sweep": ("commands.sweep", "evaluate a policy on a grid or sample of trocars", _LEARNING),
    "finetune": ("commands.finetune", "improve a trained policy in the simulator", _LEARNING),
    "calibrate": (
        "commands.calibrate",
        "add a runtime monitor to a trained policy",
        _LEARNING,
    ),
    "stress": ("commands.stress", "evaluate a policy under disturbances", _LEARNING),
    "six-blocks": ("commands.six_blocks", "evaluate six successive bimanual transfers", _LEARNING),
    "bench": ("commands.bench", "measure the inference latency of a policy (Table IV)", _LEARNING),
    "serve": ("commands.serve", "serve a policy to robots over websockets", ("sim", "serve")),
    "pack": ("commands.pack", "write a policy in half precision", _LEARNING),
    "export": (
        "commands.export_command",
        "export demonstrations to LeRobot, robomimic or zarr",
        _EXCHANGE,
    ),
    "import": (
        "commands.import_command",
        "import a dataset from LeRobot, robomimic or zarr",
        _EXCHANGE,
    ),
    "inspect": (
        "commands.inspect_command",
        "summarise a dataset, policy or result and flag anomalies",
        _EXCHANGE,
    ),
    "report": (
        "commands.report_command",
        "draw tables, figures, video and page from results",
        ("sim", "report"),
    ),
    "leaderboard": (
        "commands.leaderboard",
        "tabulate results by the trocar benchmark",
        ("sim", "train"),
    ),
    "view": ("commands.view", "show a policy, an expert or a dataset in the browser", _VIEWER),
    "teleop": ("commands.teleop", "record demonstrations by hand in the browser", _VIEWER),
    "list": (
        "commands.list_command",
        "list tasks, arms, tools, methods, presets and policies",
        ("sim",),
    ),
    "check": ("commands.check_command", "check a part, such as one of your package", _EXCHANGE),
    "find-mount": ("commands.find_mount", "search the mount of an arm for a task", _LEARNING),
    "doctor": ("doctor", "check the installation and suggest fixes", ("sim",)),
    "completion": ("commands.completion", "print the completion script of a shell", ("sim",)),
}
COMMANDS = {name: (f"starjax.{module}", *rest) for name, (module, *rest) in _TABLE.items()}

# Names of the previous release; dropped in the next.
_RENAMED = {"exercise": "six-blocks", "place": "find-mount"}
_WRITING = (errno.ENOSPC, errno.EROFS, errno.EDQUOT)
_STORAGE = (
    *_WRITING, errno.EACCES, errno.EPERM, errno.EISDIR, errno.ENOTDIR, errno.ENAMETOOLONG
)  # fmt: skip
_STOPPED = 130  # exit code after a stop, see `signals`
_BROKEN_PIPE = 141  # exit code if the output pipe is closed (128 + SIGPIPE), as by `| head`
_OURS = os.path.join(os.path.dirname(os.path.abspath(__file__)), "")
_format_with_location = warnings.formatwarning
_TRACEBACK = "--traceback"
_CACHE_ENTRY = "persistent compilation cache entry"  # in jax's warnings
_shown: set[str] = set()  # warnings that are printed once


def main() -> NoReturn:
    """Runs the console script."""
    run(dispatch)


def run(command: Callable[[Sequence[str]], int]) -> NoReturn:
    """Runs a process: `command` with the words of its command line, then exits."""
    # None for an output that was closed before the process began, as by `>&-`.
    sys.stdout = sys.stdout or open(os.devnull, "w")  # noqa: SIM115
    sys.stderr = sys.stderr or open(os.devnull, "w")  # noqa: SIM115
    sys.unraisablehook = _raise_interrupts
    warnings.formatwarning = _format_warning
    signals.interrupt_on_stops()
    code = _STOPPED
    try:
        code = guard(command, sys.argv[1:])
        if code == _STOPPED:
            signals.ignore_stops()
    except KeyboardInterrupt:  # a second stop, outside `guard`
        signals.ignore_stops()
    if code == _STOPPED:  # jax's threads may still run, and would use a finalised interpreter
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


def guard(command: Callable[[Sequence[str]], int], argv: Sequence[str]) -> int:
    """Runs a command; turns errors that its user can fix into one line and an exit code.

    The word `--traceback` anywhere in `argv` prints the traceback of such an error first.

    Returns 2 for an error on the command line, 71 for too little memory, 74 for a full or unusable
    disk, 130 after a stop such as Ctrl-C or SIGTERM (the command has saved its work and says how to
    resume), 141 if the output pipe is closed.
    """
    words = [word for word in argv if word != _TRACEBACK]
    try:
        return command(words)
    except errors.UsageError as error:
        if len(words) < len(argv):
            traceback.print_exception(error)
        return _fail(_with_flags(error), 2)
    except KeyboardInterrupt as stop:
        return _fail(str(stop) or "stopped; rerun the same command to resume", _STOPPED)
    except BrokenPipeError:
        # Python's buffered output would fail again when the process ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _BROKEN_PIPE
    except OSError as error:
        # Imported late: it imports numpy, which `--help` does without.
        from starjax.runtime import files

        if isinstance(error, files.StorageError):
            return _fail(error, 74)
        if error.errno not in _STORAGE:
            raise
        file = f": {error.filename}" if error.filename else ""
        verb = "write" if error.errno in _WRITING else "read or write"
        return _fail(f"cannot {verb}{file}: {error.strerror}", 74)
    except MemoryError as error:
        return _fail(f"too little memory ({error or 'none left'}): close other programs", 71)
    except RuntimeError as error:
        if not str(error).startswith("RESOURCE_EXHAUSTED"):
            raise
        text = str(error).splitlines()[0].removeprefix("RESOURCE_EXHAUSTED: ")
        hint = "lower --train.batch-size in training, else start with JAX_PLATFORMS=cpu"
        return _fail(f"{text} Too much for this device's memory: {hint}", 71)


def dispatch(argv: Sequence[str]) -> int:
    """Runs the subcommand that `argv` begins with."""
    name = argv[0] if argv else "--help"
    if name in ("-h", "--help"):
        width = max(map(len, COMMANDS))
        print("usage: starjax COMMAND [OPTIONS]      (starjax COMMAND --help for its options)")
        print("--traceback shows where a mistake was noticed\n")
        print("\n".join(f"  {name:{width}}  {text}" for name, (_, text, _) in COMMANDS.items()))
        return 0
    if name == "--version":
        print(__version__)
        return 0
    if name in _RENAMED:
        errors.warn_renamed(name, _RENAMED[name])
        name = _RENAMED[name]
    errors.choice("COMMAND", name, COMMANDS)
    extras.require(name, *COMMANDS[name][2])
    return load(name)(argv[1:])


def load(name: str) -> Callable[[Sequence[str]], int]:
    """Returns the function of a subcommand, `main(argv) -> exit code`."""
    module, _, function = COMMANDS[name][0].partition(":")
    return getattr(importlib.import_module(module), function or "main")


def _raise_interrupts(ignored: Any) -> None:
    """Prints an exception that Python dropped; a stop among them is raised again."""
    if ignored.exc_type is not KeyboardInterrupt:
        sys.__unraisablehook__(ignored)


def _format_warning(message: Warning | str, kind: type[Warning], file: str, *rest: Any) -> str:
    """Returns the text of a warning: ours as one line, others with their location.

    jax warns of each of hundreds of programs that its cache cannot store or load: the first warning
    becomes one line, the others are dropped.
    """
    if os.path.abspath(file).startswith(_OURS):
        return errors.printable(f"starjax: {message}\n")
    action, entry, details = str(message).partition(_CACHE_ENTRY)
    if not entry:
        return _format_with_location(message, kind, file, *rest)
    if _CACHE_ENTRY in _shown:
        return ""
    _shown.add(_CACHE_ENTRY)
    reason = " ".join(details.partition(": ")[2].split())
    return (
        f"starjax: {action.strip().lower()} compiled programs: {reason}; every start compiles them "
        "again (run starjax doctor)\n"
    )


def _with_flags(error: errors.UsageError) -> str:
    """Returns the line of an error, with flags for field names if tyro is installed."""
    try:
        from starjax.commands import options  # late: `--version` does without tyro
    except ModuleNotFoundError:
        return str(error)
    return options.spelled(error)


def _fail(message: object, code: int) -> int:
    print(errors.printable(f"starjax: {message}"), file=sys.stderr)
    return code
