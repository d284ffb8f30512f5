"""Phrases and drawing of needle pick, for reports."""

from typing import Any

import numpy as np

from starjax.sim.tasks.base import Outline, TaskText

TEXT = TaskText(
    title="needle pick",
    done="picked up the needle",
    strict="lifted by 20 mm and held for 2 s without slipping by more than 0.5 mm, its point free, "
    "in time",
    loose="the needle was lifted by 20 mm, held or thrown",
    nearly="needle lifted, but it slipped or was not held for 2 s",
    collided="pressed jaws or shaft into the foam",
    ground="the foam",
    goal="the needle is to be lifted",
)


def outline(mj_model: Any) -> Outline:
    """Reads the foam's rectangle from the compiled model.

    Args:
      mj_model: `mujoco.MjModel` with this task in it.
    """
    foam = mj_model.geom("foam")
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    return Outline((foam.pos * [1, 1, 0] + foam.size * corners,), ())
