"""The first alarm of a policy's runtime monitor in a live episode."""

import numpy as np

from starjax.addons.viewer.frame import Frame
from starjax.addons.viewer.simulation import LiveState
from starjax.policies.monitor.record import Monitor
from starjax.policies.monitor.watch import Watch


class EpisodeAlarm:
    """Scores the plans of an episode as they are made.

    Attributes:
      text: line for the page, empty without an alarm.
    """

    def __init__(self, monitor: Monitor | None) -> None:
        self._watch = Watch(monitor) if monitor else None
        self.text = ""

    def reset(self) -> None:
        """Begins another episode."""
        self.text = ""
        if self._watch:
            self._watch.reset()

    def update(self, before: Frame, live: LiveState) -> None:
        """Scores the plan of a control step from its state `before` and `live` after it."""
        if self._watch is None or before.step % self._watch.monitor.settings.execute:
            return
        plan = np.asarray(live.memory.command.pose.p[0])
        alarm = self._watch.update(plan, np.asarray(before.p_world_tip), gripper=before.gripper)
        if alarm and not self.text:
            self.text = f"alarm at {alarm.time_s:.1f} s: {alarm}"
