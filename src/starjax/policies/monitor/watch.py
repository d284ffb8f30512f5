"""The monitor of one episode on the host: fed with each new plan, it returns the first alarm."""

from typing import NamedTuple

import numpy as np

from starjax.policies.monitor import scores
from starjax.policies.monitor.record import Monitor


class Alarm(NamedTuple):
    """A score beyond its threshold.

    Attributes:
      score: name, see `scores.NAMES`.
      value: of the score, in its unit.
      threshold: of the score, in its unit.
      time_s: s, executed before the decision.
      still_s: s, over which stillness is measured.
    """

    score: str
    value: float
    threshold: float
    time_s: float
    still_s: float

    def __str__(self) -> str:
        """Describes it in one line."""
        value, limit = f"{self.value:.2f} s", f"{self.threshold:.2f} s"
        if self.score in ("clock", "progress"):
            return f"{self.score}: {value} exceed {limit}"
        if self.score == "closure":
            return f"closure: the jaws closed to {-self.value:.2f}, less than {-self.threshold:.2f}"
        if self.score == "stillness":
            value, limit = (f"{-1e3 * x:.2f} mm" for x in (self.value, self.threshold))
            return f"stillness: the tip moved {value} in {self.still_s:.1f} s, less than {limit}"
        value, limit = (f"{1e3 * x:.2f} mm" for x in (self.value, self.threshold))
        return f"{self.score}: successive plans are {value} apart, more than {limit}"


class Watch:
    """Scores of one episode so far.

    Attributes:
      monitor: calibrated thresholds.
      scores: `[S]`, of the latest decision, NaN if undefined.
    """

    def __init__(self, monitor: Monitor) -> None:
        self.monitor = monitor
        self.reset()

    def reset(self) -> None:
        """Begins another episode."""
        self.scores = np.full(len(scores.NAMES), np.nan)
        self._last: np.ndarray | None = None
        self._steps = self._advanced = 0
        self._overlaps: list[scores.Overlap] = []
        self._tips: list[np.ndarray] = []

    def update(
        self,
        plan: np.ndarray,
        tip: np.ndarray,
        steps: int | None = None,
        gripper: np.ndarray | None = None,
    ) -> Alarm | None:
        """Scores a decision; returns an alarm if a score exceeds its threshold.

        Args:
          plan: planned tips `[H, 3]` m, or `[H, A, 3]` of several arms.
          tip: measured tips `[3]` or `[A, 3]` m, of the observation that the plan was made from.
          steps: control steps executed since the previous plan's observation; holds do not count.
            By default the policy's `execute`.
          gripper: measured openings `[]` or `[A]` of that observation; None: closure is undefined.
        """
        settings = self.monitor.settings
        plan = np.asarray(plan, float).reshape(len(plan), -1, 3)
        overlap = scores.Overlap()
        if self._last is not None:
            steps = settings.execute if steps is None else steps
            self._steps += steps
            overlap = scores.overlap(self._last, plan, steps, settings.execute)
            self._advanced += overlap.advanced
        self._last = plan
        # Only the windows of the latest decision are kept.
        most = max(scores.SMOOTHED, settings.still + 1)
        self._overlaps = [*self._overlaps, overlap][-most:]
        self._tips = [*self._tips, np.asarray(tip, float).reshape(-1, 3)][-most:]
        opening = np.asarray(np.nan if gripper is None else gripper, float).reshape(-1)
        gaps, conflicts, _ = np.array(self._overlaps).T
        # Only the last row of the others counts.
        openings = np.broadcast_to(opening, (len(gaps), len(opening)))
        times, progress = (
            np.full(len(gaps), count / settings.control_hz)
            for count in (self._steps, self._advanced)
        )
        tips = np.stack(self._tips)
        rows = scores.series(gaps, conflicts, tips, openings, times, progress, settings.still)
        self.scores = rows[-1]
        return self._alarm(times[-1])

    def _alarm(self, time_s: float) -> Alarm | None:
        monitor = self.monitor
        z = (self.scores - monitor.center) / monitor.width
        z = np.where(np.isnan(z), -np.inf, z)
        worst = int(z.argmax())
        if not z[worst] > monitor.threshold:
            return None
        value, limit = float(self.scores[worst]), float(monitor.limits[worst])
        return Alarm(scores.NAMES[worst], value, limit, time_s, monitor.settings.still_s)
