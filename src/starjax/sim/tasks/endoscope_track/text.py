"""Phrases and drawing of endoscope tracking, for reports."""

from typing import Any

import numpy as np

from starjax.sim.tasks.base import Outline, TaskText

TEXT = TaskText(
    title="endoscope tracking",
    done="kept the instrument's tip in the middle of the picture",
    strict="tip in the middle within 5% of the picture's side, picture level within 3 degrees, tip "
    "6 cm away within 20%, for 90% of the time from 2 s to 29 s",
    loose="the tip never left the picture from 2 s to 29 s",
    nearly="tip always in the picture, but not in its middle, level and 6 cm away for long enough",
    collided="touched tissue or the instrument with the endoscope",
    ground="the tissue",
    goal="the coloured tip belongs in the middle of the endoscope's picture",
    lost="the tip left the picture, and was not in its middle for long enough",
)
HALF = 0.085  # m, of the square that is drawn


def outline(mj_model: Any) -> Outline:
    """Reads the vessels from the compiled model; the tissue is a square.

    Args:
      mj_model: `mujoco.MjModel` with this task in it.
    """
    corners = HALF * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    names = (mj_model.geom(i).name for i in range(mj_model.ngeom))
    vessels = (mj_model.geom(name) for name in names if name.startswith("vessel"))
    return Outline((corners,), tuple(_ends(vessel) for vessel in vessels))


def _ends(capsule: Any) -> np.ndarray:
    """The axis `[2, 3]` m of a capsule that lies flat: its z axis from the quaternion."""
    w, x, y, z = capsule.quat
    along = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    return capsule.pos + np.array([[-1.0], [1.0]]) * capsule.size[1] * along
