"""Paired comparison of two results: McNemar's test on the trials that both ran."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from starjax.core import errors
from starjax.evaluation import statistics
from starjax.evaluation.content import Trial

if TYPE_CHECKING:  # it imports `paired`
    from starjax.evaluation.result import Result

_NEAR = 1e-5  # m and rad: last bits of a drawn trocar vary between machines
TESTS = ("success", "loose", "safe")


class Paired(NamedTuple):
    """Two results on the same trials.

    Attributes:
      pairs: number of shared trials.
      only_a: successes of the first alone.
      only_b: successes of the second alone.
      p: McNemar's exact p value, two-sided.
    """

    pairs: int
    only_a: int
    only_b: int
    p: float


def identity(trial: Trial) -> tuple[int, int, int]:
    """Returns the key that pairs trials of two results: trocar, number and seed."""
    return trial.trocar, trial.trial, trial.seed


def paired(a: "Result", b: "Result", test: str = "success") -> Paired:
    """Compares two results on the trials that both ran; their order is free.

    Args:
      a, b: from `result.read` or `result.read_sweep`.
      test: field of a trial, `success` (strict), `loose` or `safe`.

    Raises:
      errors.UsageError: they share no trial, or the test is unknown.
    """
    errors.choice("test", test, TESTS)
    both = shared(a, b)
    if not both:
        expected = "results with common trials: task, time limit, seed, trocars, settings of jax"
        got = "; ".join(f"{x.scene.task}, {x.time_limit_s:g} s, seed {x.seed}" for x in (a, b))
        raise errors.UsageError("a, b", expected, got)
    ours, theirs = (np.array([getattr(x, test) for x in side], bool) for side in zip(*both))
    counts = statistics.mcnemar(ours, theirs)
    return Paired(len(both), counts["only_a"], counts["only_b"], counts["p_value"])


def shared(a: "Result", b: "Result") -> list[tuple[Trial, Trial]]:
    """Returns the trials with one task, trocar, number, seed, time limit and settings of jax."""
    if _conditions(a) != _conditions(b):
        return []
    ours, theirs = ({identity(trial): trial for trial in one.trials} for one in (a, b))
    both = [(ours[key], theirs[key]) for key in sorted(ours.keys() & theirs.keys())]
    return [(one, other) for one, other in both if _same_place(one, other)]


def _conditions(result: "Result") -> tuple[object, ...]:
    return result.scene.task, result.time_limit_s, result.about.get("jax_settings") or {}


def _same_place(one: Trial, other: Trial) -> bool:
    """Returns True if two trials of one identity have the same trocars: sweeps number their own."""
    places = [(*trial.radius, *trial.polar, *trial.azimuth) for trial in (one, other)]
    return len({len(place) for place in places}) == 1 and all(
        abs(a - b) <= _NEAR for a, b in zip(*places, strict=True)
    )
