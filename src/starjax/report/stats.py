"""Success rates with intervals and paired tests, on top of `evaluation.statistics`."""

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


def rate(successes: int, trials: int) -> Rate:
    """Makes a rate with its interval."""
    return Rate(successes, trials, successes / trials, *statistics.wilson(successes, trials))


def gap(seen: Rate, unseen: Rate) -> tuple[float, float, float]:
    """Returns the generalization gap (Eq. 20) with its 95% interval: (gap, low, high)."""
    outcomes = [np.arange(score.trials) < score.successes for score in (seen, unseen)]
    middle, (low, high) = statistics.generalization_gap(*outcomes)
    return middle, low, high


def holm(p_values: Sequence[float]) -> list[float]:
    """Adjusts p values for multiple comparisons by Holm's step-down correction."""
    adjusted, worst = [0.0] * len(p_values), 0.0
    for rank, i in enumerate(sorted(range(len(p_values)), key=p_values.__getitem__)):
        worst = max(worst, min(1.0, (len(p_values) - rank) * p_values[i]))
        adjusted[i] = worst
    return adjusted
