"""Scores of a running policy from its plans and measurements alone; higher is more suspicious.

disagreement   m, between successive plans at the control steps that both describe
stillness      m, negative path of the measured tip over a window: it rises to 0 as the tools stop
clock          s, time since the episode began
closure        negative measured opening of the jaws: it rises to 1 as they close on nothing
conflict       m, as the disagreement, at the shift in time that brings the two plans closest
progress       s, time by which the plans advanced: a plan that starts over advances nothing

The first is the temporal consistency of STAC (Agia et al., 2024, arXiv 2410.04640) with one sample,
which needs neither a second inference nor a second network. Where observations or commands are
late, each plan begins at an old position: plans disagree, and a trial takes longer, although the
policy pursues its aim. Conflict and progress compensate for that; new monitors use them instead of
disagreement and clock.

Shape letters: D decisions of an episode, S scores, A arms, H control steps of a plan, T of an
episode.
"""

import itertools
from typing import NamedTuple

import numpy as np

NAMES = ("disagreement", "stillness", "clock", "closure", "conflict", "progress")
CALIBRATED = ("stillness", "closure", "conflict", "progress")  # scores of new monitors
SMOOTHED = 3  # decisions whose disagreement is averaged: single plans jump at a grasp
# m, shifts whose distance exceeds the smallest one by less are equal, and the largest counts: a tip
# at rest has plans that are as close at any shift
_EQUAL = 5e-4


class ScoreSettings(NamedTuple):
    """Settings of the scores.

    Attributes:
      execute: control steps between two decisions.
      control_hz: control steps per second.
      still: decisions over which the tip's path is measured.
    """

    execute: int
    control_hz: float
    still: int

    @property
    def period_s(self) -> float:
        """Returns the seconds between two decisions."""
        return self.execute / self.control_hz

    @property
    def still_s(self) -> float:
        """Returns the seconds over which the tip's path is measured."""
        return self.still * self.period_s


def gap(last: np.ndarray, plan: np.ndarray, shift: int, execute: int) -> float:
    """Returns the mean distance in m between two plans at their common control steps.

    The arm with the largest mean counts. NaN if the plans have no common step.

    Args:
      last: `[H, A, 3]` m, planned tips of the previous plan.
      plan: `[H, A, 3]` m, those of this plan.
      shift: control steps executed between the two decisions.
      execute: maximum number of compared commands.
    """
    count = min(execute, len(last) - shift, len(plan))
    if count <= 0:
        return np.nan
    apart = np.linalg.norm(last[shift : shift + count] - plan[:count], axis=-1)
    return float(apart.mean(axis=0).max())


class Overlap(NamedTuple):
    """Comparison of a plan with the previous one; NaN and 0 for the first plan.

    Attributes:
      gap: m, see `gap`.
      conflict: m, the smallest gap over all shifts up to the executed one.
      advanced: control steps, the shift of the smallest gap.
    """

    gap: float = np.nan
    conflict: float = np.nan
    advanced: int = 0


def overlap(last: np.ndarray, plan: np.ndarray, shift: int, execute: int) -> Overlap:
    """Compares two plans; the arguments are those of `gap`."""
    gaps = np.array([gap(last, plan, k, execute) for k in range(shift + 1)])
    if not np.isfinite(gaps).any():
        return Overlap(advanced=shift)
    smallest = float(np.nanmin(gaps))
    return Overlap(float(gaps[-1]), smallest, int(np.flatnonzero(gaps <= smallest + _EQUAL)[-1]))


def series(
    gaps: np.ndarray,
    conflicts: np.ndarray,
    tips: np.ndarray,
    openings: np.ndarray,
    times: np.ndarray,
    progress: np.ndarray,
    still: int,
) -> np.ndarray:
    """Returns the scores `[D, S]` of successive decisions, NaN where a window is not full yet.

    Args:
      gaps: `[D]` m, see `Overlap`; NaN for the first decision.
      conflicts: `[D]` m, likewise.
      tips: `[D, A, 3]` m, measured tips at the decisions.
      openings: `[D, A]` in [-1 closed, +1 open], measured at the decisions; NaN where unknown.
      times: `[D]` s, of the decisions.
      progress: `[D]` s, by which the plans advanced until the decisions.
      still: see `ScoreSettings`.
    """
    scores = np.full((len(gaps), len(NAMES)), np.nan)
    scores[SMOOTHED - 1 :, 0] = _windows(gaps, SMOOTHED).mean(axis=-1)
    moves = np.linalg.norm(np.diff(tips, axis=0), axis=-1)
    # One arm may rest while another works: the longest path of all arms counts.
    scores[still:, 1] = -_windows(moves, still).sum(axis=-1).max(axis=-1, initial=0.0)
    scores[:, 2] = times
    scores[:, 3] = -openings.min(axis=-1)
    scores[SMOOTHED - 1 :, 4] = _windows(conflicts, SMOOTHED).mean(axis=-1)
    scores[:, 5] = progress
    return scores


def of_trial(
    planned: np.ndarray,
    ahead: np.ndarray,
    tip: np.ndarray,
    opening: np.ndarray,
    settings: ScoreSettings,
) -> np.ndarray:
    """Returns the scores `[D, S]` of a recorded episode.

    The last decision's plan is compared only at the control steps that the episode still had.

    Args:
      planned: `[T, A, 3]` m, planned tip of each control step.
      ahead: `[T, A, 3]` m, the same plan's tip `execute` control steps later, NaN beyond its end.
      tip: `[T, A, 3]` m, measured before each control step.
      opening: `[T, A]` in [-1 closed, +1 open], measured before each control step.
      settings: of the scores.
    """
    execute = settings.execute
    first = np.arange(0, len(planned), execute)
    plans = []
    for start in first:
        later = ahead[start : start + execute]
        later = later[np.isfinite(later).all(axis=(1, 2))]
        plans.append((planned[start : start + execute], later))
    overlaps = [Overlap()]
    for (done, later), (plan, _) in itertools.pairwise(plans):
        overlaps.append(overlap(np.concatenate([done, later]), plan, execute, execute))
    gaps, conflicts, advanced = np.array(overlaps).T
    times, progress = first / settings.control_hz, advanced.cumsum() / settings.control_hz
    return series(gaps, conflicts, tip[first], opening[first], times, progress, settings.still)


def _windows(values: np.ndarray, size: int) -> np.ndarray:
    """Returns all windows `[max(D - size + 1, 0), ..., size]` of values `[D, ...]`."""
    if len(values) < size:
        return np.zeros((0, *values.shape[1:], size))
    return np.lib.stride_tricks.sliding_window_view(values, size, axis=0)
