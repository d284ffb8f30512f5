"""Rollouts as one HTML file with a 3D view that plays without a server."""

from collections.abc import Sequence

import mujoco

from starjax.addons.viewer import page
from starjax.addons.viewer.frame import Frame
from starjax.addons.viewer.stage import Stage, aim

_HOLD_S = 1.0  # time that the last frame stays
_STRIDE = 2  # control steps between two frames: 15 frames a second play smoothly


def html(
    model: mujoco.MjModel, rollouts: Sequence[Sequence[Frame]], hz: float, longest_s: float
) -> str:
    """Returns a page of rollouts side by side; a shorter one holds its last frame.

    Args:
      model: their scene.
      rollouts: frames of each.
      hz: control steps per second.
      longest_s: longest duration shown, in s.
    """
    clips = [frames[: round(longest_s * hz)] for frames in rollouts]
    with page.serve(page.ANY) as server:
        stages = [Stage(server.scene, model, i) for i in range(len(clips))]
        aim(server, len(clips))

        def show(t: int) -> None:
            for stage, frames in zip(stages, clips):
                stage.show(frames[min(t, len(frames) - 1)])

        show(0)
        recording = server.get_scene_serializer()
        steps = max(map(len, clips))
        for t in range(0, steps, _STRIDE):
            show(t)
            recording.insert_sleep(_STRIDE / hz)
        show(steps)
        recording.insert_sleep(_HOLD_S)
        return recording.as_html()
