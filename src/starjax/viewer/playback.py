"""A rollout as one HTML file in which it plays and can be turned, without a server."""

from collections.abc import Sequence

import mujoco
import numpy as np

from starjax.viewer import server as pages
from starjax.viewer.frame import Frame
from starjax.viewer.stage import Stage, aim

_REST_S = 1.0  # that the last moment stays
_EVERY = 2  # control steps between two moments: 15 a second play smoothly


def html(
    model: mujoco.MjModel, rollouts: Sequence[Sequence[Frame]], hz: float, longest_s: float
) -> str:
    """The page of rollouts side by side; a shorter one stays as it ended.

    Args:
      model: of their scene.
      hz: control steps a second.
      longest_s: s shown of a rollout.
    """
    shown = [list(frames[: round(longest_s * hz)]) for frames in rollouts]
    with pages.opened(pages.ANY) as server:
        stages = [Stage(server.scene, model, i) for i in range(len(shown))]
        aim(server, len(shown))
        for stage, frames in zip(stages, shown):
            stage.show(frames[0])
        recording = server.get_scene_serializer()
        steps = np.arange(0, max(map(len, shown)), _EVERY)
        for t in steps:
            for stage, frames in zip(stages, shown):
                stage.show(frames[min(t, len(frames) - 1)])
            recording.insert_sleep(_EVERY / hz)
        for stage, frames in zip(stages, shown):
            stage.show(frames[-1])
        recording.insert_sleep(_REST_S)
        return recording.as_html()
