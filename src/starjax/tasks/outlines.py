"""Lines and areas of compiled geoms, for the outlines of tasks.

`mj_model` is a `mujoco.MjModel` with the task in it.
"""

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:  # a robot loads tasks without the simulator
    import mujoco

CORNERS = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])  # a square of side 2


def rectangle(mj_model: "mujoco.MjModel", name: str) -> np.ndarray:
    """Returns the corners `[4, 3]` m of a box or plane, on the ground."""
    geom = mj_model.geom(name)
    return geom.pos * [1, 1, 0] + geom.size * CORNERS


def named(mj_model: "mujoco.MjModel", *prefixes: str) -> list[Any]:
    """Returns the geoms whose names begin with one of the prefixes."""
    geoms = (mj_model.geom(i) for i in range(mj_model.ngeom))
    return [geom for geom in geoms if geom.name.startswith(prefixes)]


def capsule_ends(capsule: Any) -> np.ndarray:
    """Returns the ends `[2, 3]` m of a capsule's axis in its body's frame."""
    w, x, y, z = capsule.quat
    along = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    return capsule.pos + np.array([[-1.0], [1.0]]) * capsule.size[1] * along


def stick(foot: np.ndarray, height: float) -> np.ndarray:
    """Returns a vertical line `[2, 3]` from the ground to `height` m above `foot`."""
    return np.array([[*foot[:2], 0.0], [*foot[:2], height]])
