"""Success counts with their intervals; the statistics themselves are `evaluation.metrics`'s."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from starjax.evaluation import statistics


class Rate(NamedTuple):
    """Successes out of trials with a 95% Wilson interval; rates are fractions in [0, 1]."""

    successes: int
    trials: int
    rate: float
    low: float
    high: float


class Paired(NamedTuple):
    """Two methods on the same trials: how often only one of them succeeded, and McNemar's p."""

    pairs: int
    only_a: int
    only_b: int
    p: float


def rate(successes: int, trials: int) -> Rate:
    """A rate with its interval."""
    return Rate(successes, trials, successes / trials, *statistics.wilson(successes, trials))


def gap(seen: Rate, unseen: Rate) -> tuple[float, float, float]:
    """Generalization gap (Eq. 20) with its 95% interval: (gap, low, high)."""
    outcomes = [np.arange(score.trials) < score.successes for score in (seen, unseen)]
    middle, (low, high) = statistics.generalization_gap(*outcomes)
    return middle, low, high


def mcnemar(a: Sequence[bool], b: Sequence[bool]) -> Paired:
    """McNemar's exact test of outcomes on the same trials."""
    found = statistics.mcnemar(np.array(a, bool), np.array(b, bool))
    return Paired(len(a), found["only_a"], found["only_b"], found["p_value"])


def holm(p_values: Sequence[float]) -> list[float]:
    """Holm's step-down correction: p values that may be read together at one level."""
    adjusted, worst = [0.0] * len(p_values), 0.0
    for rank, i in enumerate(sorted(range(len(p_values)), key=p_values.__getitem__)):
        worst = max(worst, min(1.0, (len(p_values) - rank) * p_values[i]))
        adjusted[i] = worst
    return adjusted
