"""The console script `starjax`: imports the module of the called subcommand only."""

import errno
import importlib
import os
import sys
import traceback
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NoReturn

from starjax import __version__
from starjax.core import errors, extensions, extras
from starjax.core.extensions import Subcommand
from starjax.core.registry import Registry
from starjax.runtime import signals

_LEARNING = ("sim", "train")
_ALL = (*_LEARNING, "report")
_EXCHANGE = (*_LEARNING, "formats")
# The subcommands of the core; those of add-ons and of other packages follow in `COMMANDS`.
CORE = {
    "run": Subcommand(
        "starjax.cli.run", "run the full pipeline: collect, train, evaluate, report", _ALL
    ),
    "collect": Subcommand("starjax.cli.run:collect", "collect demonstrations only", _LEARNING),
    "train": Subcommand("starjax.cli.run:train", "collect demonstrations and train", _LEARNING),
    "evaluate": Subcommand(
        "starjax.cli.evaluate", "evaluate a policy on its task's trocars", _LEARNING
    ),
    "sweep": Subcommand(
        "starjax.cli.sweep", "evaluate a policy on a grid or sample of trocars", _LEARNING
    ),
    "stress": Subcommand("starjax.cli.stress", "evaluate a policy under disturbances", _LEARNING),
    "bench": Subcommand(
        "starjax.cli.bench", "measure the inference latency of a policy (Table IV)", _LEARNING
    ),
    "serve": Subcommand(
        "starjax.cli.serve", "serve a policy to robots over websockets", ("sim", "serve")
    ),
    "pack": Subcommand("starjax.cli.pack", "write a policy in half precision", _LEARNING),
    "inspect": Subcommand(
        "starjax.cli.inspect_command",
        "summarise a dataset, policy or result and flag anomalies",
        _EXCHANGE,
    ),
    "report": Subcommand(
        "starjax.cli.report_command",
        "draw tables, figures, video and page from results",
        ("sim", "report"),
    ),
    "leaderboard": Subcommand(
        "starjax.cli.leaderboard", "tabulate results by the trocar benchmark", ("sim", "train")
    ),
    "list": Subcommand(
        "starjax.cli.list_command",
        "list tasks, arms, tools, methods, presets and policies",
        ("sim",),
    ),
    "check": Subcommand(
        "starjax.cli.check_command", "check a part, such as one of your package", _EXCHANGE
    ),
    "doctor": Subcommand(
        "starjax.cli.doctor", "check the installation and suggest fixes", ("sim",)
    ),
    "completion": Subcommand(
        "starjax.cli.completion", "print the completion script of a shell", ("sim",)
    ),
}
COMMANDS = {**CORE, **extensions.commands()}
_REGISTRY = Registry("command", COMMANDS, "starjax.core.extensions:Subcommand")

_WRITING = (errno.ENOSPC, errno.EROFS, errno.EDQUOT)
_STORAGE = (
    *_WRITING, errno.EACCES, errno.EPERM, errno.EISDIR, errno.ENOTDIR, errno.ENAMETOOLONG
)  # fmt: skip
_NAME_WIDTH = 11  # for subcommands in the help
_STOPPED = 130  # exit code after a stop, see `signals`
_BROKEN_PIPE = 141  # exit code if the output pipe is closed (128 + SIGPIPE), as by `| head`
_OURS = os.path.join(os.path.dirname(os.path.dirname(os.path.abspath(__file__))), "")
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
        print("usage: starjax COMMAND [OPTIONS]      (starjax COMMAND --help for its options)")
        print("--traceback shows where a mistake was noticed")
        for title, commands in _groups().items():
            print(f"\n{title}" if title else "")
            for each, row in commands.items():
                print(f"  {each:{_NAME_WIDTH}}  {row.summary}")
        return 0
    if name == "--version":
        print(__version__)
        return 0
    extras.require(name, *command(name).extras)
    return load(name)(argv[1:])


def command(name: str) -> Subcommand:
    """Returns a subcommand of starjax or of another package.

    Raises:
      errors.UsageError: it is unknown; names the add-ons that are here.
    """
    if name in COMMANDS:  # without a look at the entry points of all packages
        return COMMANDS[name]
    try:
        errors.choice("COMMAND", name, _REGISTRY.names())
    except errors.UsageError as error:
        here = ", ".join(extensions.tables()) or "none"
        hint = "; ".join(filter(None, (error.hint, f"add-ons here: {here}")))
        raise errors.UsageError("COMMAND", error.expected, error.got, hint) from None
    return _REGISTRY.get(name)


def load(name: str) -> Callable[[Sequence[str]], int]:
    """Returns the function of a subcommand, `main(argv) -> exit code`."""
    module, _, function = command(name).path.partition(":")
    return getattr(importlib.import_module(module), function or "main")


def _groups() -> dict[str, Mapping[str, Subcommand]]:
    """Returns the subcommands by heading: those of the core first, without one."""
    tables = extensions.tables()
    added = {f"{name}: {table.summary}": table.commands for name, table in tables.items()}
    others = [name for name in _REGISTRY.names() if name not in COMMANDS]
    packages = {"of other packages": {name: command(name) for name in others}}
    return {"": CORE, **{title: rows for title, rows in (added | packages).items() if rows}}


def _raise_interrupts(ignored: "sys.UnraisableHookArgs") -> None:
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
        from starjax.cli import options  # late: `--version` does without tyro
    except ModuleNotFoundError:
        return str(error)
    return options.spelled(error)


def _fail(message: object, code: int) -> int:
    print(errors.printable(f"starjax: {message}"), file=sys.stderr)
    return code
