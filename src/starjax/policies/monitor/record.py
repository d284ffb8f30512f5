"""A runtime monitor: one threshold for all scores, and its JSON form.

A score is centred and scaled, z = (score - center) / width. The alarm is the first decision at
which the largest z of a trial exceeds the threshold. Low scores never raise an alarm.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from starjax.policies.monitor import scores as scores_lib
from starjax.policies.monitor.scores import ScoreSettings


class Monitor(NamedTuple):
    """A calibrated monitor.

    Attributes:
      center: `[S]`, of the scores, in their units; NaN of a score that raises no alarms.
      width: `[S]`, of the scores, in their units, NaN as the center.
      threshold: of the scaled scores.
      clock_s: s, threshold of the clock if it were the only score, at alpha or 5%, the
        larger; a monitor counts only where it beats this.
      alpha: nominal false alarm rate on successes.
      count: n, successes that the threshold comes from.
      settings: of the scores.
      digest: of the weights that it was calibrated with, see `policy_file.monitor_digest`.
    """

    center: np.ndarray
    width: np.ndarray
    threshold: float
    clock_s: float
    alpha: float
    count: int
    settings: ScoreSettings
    digest: str

    @property
    def limits(self) -> np.ndarray:
        """Returns the thresholds `[S]` in the units of the scores, NaN of scores without alarms."""
        return self.center + self.threshold * self.width


def first_alarms(monitor: Monitor, scores: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Finds the first alarm of each trial.

    Args:
      monitor: calibrated.
      scores: `[M, D, S]`, NaN where a score is undefined or a trial has ended.

    Returns:
      `[M]` s, time of the first alarm, infinity without one; `[M]` index of its score.
    """
    z = np.nan_to_num((scores - monitor.center) / monitor.width, nan=-np.inf, posinf=np.inf)
    over = np.any(z > monitor.threshold, axis=-1)
    first = over.argmax(axis=1)
    times = np.where(np.any(over, axis=1), first * monitor.settings.period_s, np.inf)
    return times, z[np.arange(len(z)), first].argmax(axis=-1)


def to_json(monitor: Monitor) -> dict[str, Any]:
    """Returns the monitor as JSON values, without scores that raise no alarms."""
    raises = np.isfinite(monitor.center)
    values = {**monitor._asdict(), "settings": monitor.settings._asdict()}
    values["scores"] = [name for name, is_raised in zip(scores_lib.NAMES, raises) if is_raised]
    values |= {"center": monitor.center[raises], "width": monitor.width[raises]}
    return {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in values.items()}


def from_json(values: dict[str, Any]) -> Monitor:
    """Reads the values of `to_json`.

    Raises:
      ValueError: a field is missing or malformed, or a score is unknown to this version.
    """
    names = values.get("scores")
    known = [name for name in scores_lib.NAMES if name in (names or ())]
    if not known or known != names:
        raise ValueError(
            f"monitor: expected of {_listed(scores_lib.NAMES)}, in this order, got {names}"
        )
    places = [scores_lib.NAMES.index(name) for name in known]

    def filled(name: str) -> np.ndarray:
        whole = np.full(len(scores_lib.NAMES), np.nan)
        whole[places] = np.asarray(values[name], float).reshape(len(known))
        return whole

    try:
        monitor = Monitor(
            center=filled("center"),
            width=filled("width"),
            threshold=float(values["threshold"]),
            clock_s=float(values["clock_s"]),
            alpha=float(values["alpha"]),
            count=int(values["count"]),
            settings=ScoreSettings(**values["settings"]),
            digest=str(values["digest"]),
        )
    except (KeyError, TypeError) as error:
        raise ValueError(f"monitor: malformed: {error}") from error
    finite = np.isfinite([*monitor.limits[places], monitor.clock_s]).all()
    if not finite or not (monitor.width[places] > 0).all():
        raise ValueError("monitor: expected finite thresholds and positive widths")
    return monitor


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names)
