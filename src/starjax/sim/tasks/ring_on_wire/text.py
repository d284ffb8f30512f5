"""Phrases and drawing of ring on wire, for reports."""

from typing import Any

import numpy as np

from starjax.sim.tasks.base import Outline, TaskText

TEXT = TaskText(
    title="ring on wire",
    done="carried the ring along the wire to its end",
    strict="at the marked end of the wire, released and at rest, having touched the bent part for "
    "0.3 s at most, in time",
    loose="the ring came to the marked end, however often it touched the wire",
    nearly="ring at the marked end, but not released and at rest there",
    collided="touched base or wire with shaft or arm",
    ground="the base",
    goal="the ring belongs at the marked end of the wire",
    lost="the ring touched the bent part of the wire for longer than 0.3 s",
)


def outline(mj_model: Any) -> Outline:
    """Reads the base's rectangle and the wire from the compiled model.

    Args:
      mj_model: `mujoco.MjModel` with this task in it.
    """
    base = mj_model.geom("base")
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    names = [mj_model.geom(i).name for i in range(mj_model.ngeom)]
    pieces = tuple(
        capsule_ends(mj_model.geom(name)) for name in names if name.startswith(("wire", "post"))
    )
    return Outline((base.pos * [1, 1, 0] + base.size * corners,), pieces)


def capsule_ends(capsule: Any) -> np.ndarray:
    """The ends `[2, 3]` m of a capsule's axis in its body's frame, from its quaternion's z axis."""
    w, x, y, z = capsule.quat
    along = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    return capsule.pos + np.array([[-1.0], [1.0]]) * capsule.size[1] * along
