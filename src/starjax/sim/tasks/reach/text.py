"""Phrases and drawing of reach, for reports."""

from typing import Any

import numpy as np

from starjax.sim.tasks.base import Outline, TaskText

TEXT = TaskText(
    title="reach",
    done="brought the tip to the marked point",
    strict="within 2 mm of the marked point and at rest for 1 s, in time",
    loose="the tip was within 5 mm of the marked point, moving or not",
    nearly="near the marked point, but not at rest on it",
    collided="touched the pad, or a post with the shaft",
    ground="the pad",
    goal="the tip belongs on the coloured mark",
)


def outline(mj_model: Any) -> Outline:
    """Reads the pad's rectangle and the posts from the compiled model.

    Args:
      mj_model: `mujoco.MjModel` with this task in it.
    """
    pad = mj_model.geom("pad")
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    names = (mj_model.geom(i).name for i in range(mj_model.ngeom))
    marks = [mj_model.geom(name).pos for name in names if name.startswith("mark")]
    lines = tuple(np.array([[*mark[:2], 0.0], mark]) for mark in marks)
    return Outline((pad.pos * [1, 1, 0] + pad.size * corners,), lines)
