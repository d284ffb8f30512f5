"""Scores of a running policy from its plans and measurements alone; higher is more suspicious.

disagreement   m, between successive plans at the control steps that both describe
stillness      m, negative path of the measured tip over a window: it rises to 0 as the tools stop
clock          s, time since the episode began
closure        negative measured opening of the jaws: it rises to 1 as they close on nothing

The first is the temporal consistency of STAC (Agia et al., 2024, arXiv 2410.04640) with one sample,
which needs neither a second inference nor a second network.

Shape letters: D decisions of an episode, S scores, A arms, H control steps of a plan, T of an
episode.
"""

from typing import NamedTuple

import numpy as np

NAMES = ("disagreement", "stillness", "clock", "closure")
SMOOTHED = 3  # decisions whose disagreement is averaged: single plans jump at a grasp


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
    count = min(execute, len(last) - shift)
    if count <= 0:
        return np.nan
    apart = np.linalg.norm(last[shift : shift + count] - plan[:count], axis=-1)
    return float(apart.mean(axis=0).max())


def series(
    gaps: np.ndarray, tips: np.ndarray, openings: np.ndarray, times: np.ndarray, still: int
) -> np.ndarray:
    """Returns the scores `[D, S]` of successive decisions, NaN where a window is not full yet.

    Args:
      gaps: `[D]` m, see `gap`; NaN for the first decision.
      tips: `[D, A, 3]` m, measured tips at the decisions.
      openings: `[D, A]` in [-1 closed, +1 open], measured at the decisions; NaN where unknown.
      times: `[D]` s, of the decisions.
      still: see `ScoreSettings`.
    """
    scores = np.full((len(gaps), len(NAMES)), np.nan)
    scores[SMOOTHED - 1 :, 0] = _windows(gaps, SMOOTHED).mean(axis=-1)
    moves = np.linalg.norm(np.diff(tips, axis=0), axis=-1)
    # One arm may rest while another works: the longest path of all arms counts.
    scores[still:, 1] = -_windows(moves, still).sum(axis=-1).max(axis=-1, initial=0.0)
    scores[:, 2] = times
    scores[:, 3] = -openings.min(axis=-1)
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
    first = np.arange(0, len(planned), settings.execute)
    gaps = np.full(len(first), np.nan)
    apart = np.linalg.norm(planned[settings.execute :] - ahead[: -settings.execute], axis=-1)
    for decision, start in enumerate(first[:-1], 1):
        common = apart[start : start + settings.execute]
        common = common[np.isfinite(common).all(axis=-1)]
        gaps[decision] = common.mean(axis=0).max() if len(common) else np.nan
    times = first / settings.control_hz
    return series(gaps, tip[first], opening[first], times, settings.still)


def _windows(values: np.ndarray, size: int) -> np.ndarray:
    """Returns all windows `[max(D - size + 1, 0), ..., size]` of values `[D, ...]`."""
    if len(values) < size:
        return np.zeros((0, *values.shape[1:], size))
    return np.lib.stride_tricks.sliding_window_view(values, size, axis=0)
