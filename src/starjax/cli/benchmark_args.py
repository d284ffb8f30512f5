"""Flag of evaluate, sweep and stress for the trials of the trocar benchmark."""

import dataclasses
from typing import Any, TypeVar

from starjax.cli import checks
from starjax.core import errors
from starjax.evaluation import protocol

ArgsT = TypeVar("ArgsT", bound="BenchmarkArgs")
_FIXED = ("eval.trials", "eval.time_limit_s")


@dataclasses.dataclass(frozen=True)
class BenchmarkArgs:
    """Flag of commands whose results `starjax leaderboard` reads."""

    # trials, seed and time limit of the trocar benchmark, see starjax leaderboard
    benchmark: bool = False


def check(args: BenchmarkArgs, default: Any, *fields: str) -> None:
    """Raises UsageError if --benchmark comes with another value of a setting that it fixes.

    Args:
      args: settings of a command.
      default: those without flags.
      fields: further settings that it fixes.
    """
    if args.benchmark:
        for field in (*_FIXED, _seed(args), *fields):
            value = _of(args, field)
            checks.expect(value == _of(default, field), field, "no value with --benchmark", value)


def with_trials(args: ArgsT, command: str, task: str) -> ArgsT:
    """Returns the settings of a command, with --benchmark those of the benchmark's trials.

    Raises:
      errors.UsageError: the benchmark lacks the task.
    """
    if not args.benchmark:
        return args
    errors.choice("--benchmark", task, protocol.TIME_LIMIT_S)
    trials: Any = protocol.settings(command, task, args.eval)  # type: ignore
    if _seed(args) == "seed":
        return dataclasses.replace(args, eval=trials, seed=protocol.SEED)  # type: ignore
    return dataclasses.replace(args, eval=dataclasses.replace(trials, seed=protocol.SEED))  # type: ignore


def _seed(args: BenchmarkArgs) -> str:
    """Returns the field with the seed of the trials; that of a run may be its training's alone."""
    return "eval.seed" if hasattr(args.eval, "seed") else "seed"


def label() -> str:
    """Returns the word for the benchmark in names of directories."""
    return f"benchmark{protocol.VERSION}"


def _of(args: BenchmarkArgs, field: str) -> Any:
    for name in field.split("."):
        args = getattr(args, name)
    return args
