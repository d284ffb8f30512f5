"""One threshold for all scores, by conformal prediction over whole trials.

Each score is centred and scaled on a first set of successes: z = (score - center) / width. A trial
of a second set has the number M = max z over its scores and decisions. The threshold is the
ceil((n + 1)(1 - alpha))-th smallest M of these n successes. A new success, exchangeable with them,
then raises an alarm with a probability of at most alpha, for any length of the trials and any
dependence of the scores on each other and on time. Bands are one-sided: low scores never raise an
alarm.
"""

import math
from collections.abc import Sequence

import numpy as np

from starjax.core import errors
from starjax.policies.monitor import scores as scores_lib
from starjax.policies.monitor.record import Monitor
from starjax.policies.monitor.scores import ScoreSettings

# Fractions of the trials for scale and threshold; the rest tests the monitor.
_FIT, _CALIBRATE = 0.15, 0.425
_SPREAD = (0.1, 0.9)  # quantiles whose distance is a score's width
CLOCK_ALPHA = 0.05  # false alarms of the clock that monitors are compared with
_TINY = 1e-9  # m and s, the least width: against a division by zero
_ROUNDING = 1e-9  # rounding of a rank: (n + 1)(1 - alpha) may exceed an integer by rounding


def fit(scores: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns center and width `[S]`: median and spread of the trials' largest scores.

    A score without a finite value, as the disagreement of plans that never overlap, gets 0 and 1.

    Args:
      scores: `[M, D, S]` of successes, NaN where a score is undefined or a trial has ended.
    """
    center, width = np.zeros(scores.shape[-1]), np.ones(scores.shape[-1])
    for i, largest in enumerate(_largest(scores, axis=1).T):
        if (known := largest[np.isfinite(largest)]).size:
            low, high = np.quantile(known, _SPREAD)
            center[i], width[i] = np.median(known), max(high - low, _TINY)
    return center, width


def maxima(scores: np.ndarray, center: np.ndarray, width: np.ndarray) -> np.ndarray:
    """Returns M `[M]` of trials `[M, D, S]`; -inf of a trial without any score."""
    return _largest((scores - center) / width, axis=(1, 2))


def threshold(values: np.ndarray, alpha: float) -> float:
    """Returns the ceil((n + 1)(1 - alpha))-th smallest of n values, infinity if n is too small."""
    rank = math.ceil((len(values) + 1) * (1.0 - alpha) - _ROUNDING)
    return float(np.sort(values)[rank - 1]) if rank <= len(values) else math.inf


def parts(count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Divides trials, `[count]` bool each: for the scale, for the threshold, for the test."""
    place = np.arange(count) / count
    for_scale, is_test = place < _FIT, place >= _FIT + _CALIBRATE
    return for_scale, ~for_scale & ~is_test, is_test


def required(alpha: float) -> int:
    """Returns the least number of successes for which `threshold` is finite."""
    return math.ceil(1.0 / alpha - 1.0 - _ROUNDING)


def calibrate(
    fitted: np.ndarray,
    successes: np.ndarray,
    alpha: float,
    settings: ScoreSettings,
    digest: str = "",
    names: Sequence[str] = scores_lib.CALIBRATED,
) -> Monitor:
    """Calibrates a monitor with two disjoint sets of successful trials.

    Args:
      fitted: scores `[M, D, S]` of the trials for center and width.
      successes: `[n, D, S]`, those of the trials for the threshold.
      alpha: nominal false alarm rate.
      settings: of the scores.
      digest: of the weights.
      names: scores that raise alarms.

    Raises:
      errors.UsageError: there are too few successes for this alpha.
    """
    if len(successes) < (least := required(alpha)) or not len(fitted):
        expected = f"{least} successes for the threshold at alpha {alpha:g}, and 1 for the scale"
        got = f"{len(successes)}, and {len(fitted)} for the scale"
        hint = "run more trials, or choose a larger alpha"
        raise errors.UsageError("trials", expected, got, hint)
    center, width = fit(fitted)
    others = [name not in names for name in scores_lib.NAMES]
    center[others] = width[others] = np.nan
    clock = scores_lib.NAMES.index("clock")
    return Monitor(
        center=center,
        width=width,
        threshold=threshold(maxima(successes, center, width), alpha),
        clock_s=threshold(_largest(successes[..., clock], axis=1), max(alpha, CLOCK_ALPHA)),
        alpha=alpha,
        count=len(successes),
        settings=settings,
        digest=digest,
    )


def _largest(values: np.ndarray, axis: int | tuple[int, ...]) -> np.ndarray:
    """Returns maxima that ignore NaN; -inf where all values are NaN."""
    return np.where(np.isnan(values), -np.inf, values).max(axis=axis, initial=-np.inf)
