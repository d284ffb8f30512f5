"""Intervals and tests for success counts: Wilson, Newcombe for the gap, McNemar exact, Holm."""

import math
from collections.abc import Sequence
from typing import NamedTuple

Z95 = 1.959964


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


def wilson(successes: int, trials: int) -> Rate:
    """Rate with its Wilson score interval, which stays honest at 0 and at n out of n."""
    if trials <= 0 or not 0 <= successes <= trials:
        raise ValueError(
            f"expected 0 <= successes <= trials and trials > 0, got {successes}/{trials}"
        )
    rate, z2 = successes / trials, Z95**2 / trials
    centre = (rate + z2 / 2) / (1 + z2)
    half = math.sqrt(z2 * (rate * (1 - rate) + z2 / 4)) / (1 + z2)
    low = 0.0 if successes == 0 else centre - half
    high = 1.0 if successes == trials else centre + half
    return Rate(successes, trials, rate, low, high)


def gap(seen: Rate, unseen: Rate) -> tuple[float, float, float]:
    """Generalization gap (Eq. 20) with Newcombe's 95% interval, built from the two Wilson ones."""
    difference = seen.rate - unseen.rate
    low = difference - math.hypot(seen.rate - seen.low, unseen.high - unseen.rate)
    high = difference + math.hypot(seen.high - seen.rate, unseen.rate - unseen.low)
    return difference, low, high


def mcnemar(a: Sequence[bool], b: Sequence[bool]) -> Paired:
    """Exact two-sided McNemar test: under the null, each discordant pair is a fair coin."""
    if len(a) != len(b):
        raise ValueError(f"expected as many outcomes of a as of b, got {len(a)} and {len(b)}")
    only_a = sum(x and not y for x, y in zip(a, b, strict=True))
    only_b = sum(y and not x for x, y in zip(a, b, strict=True))
    n = only_a + only_b
    tail = sum(math.comb(n, k) for k in range(min(only_a, only_b) + 1)) / 2**n
    return Paired(len(a), only_a, only_b, min(1.0, 2 * tail))


def holm(p_values: Sequence[float]) -> list[float]:
    """Holm's step-down correction: p values that may be read together at one level."""
    adjusted, worst = [0.0] * len(p_values), 0.0
    for rank, i in enumerate(sorted(range(len(p_values)), key=p_values.__getitem__)):
        worst = max(worst, min(1.0, (len(p_values) - rank) * p_values[i]))
        adjusted[i] = worst
    return adjusted
