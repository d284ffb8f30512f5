"""The needle's place in the jaws."""

import jax.numpy as jnp
import numpy as np

from starjax.addons.suture.tissue.needle import Needle
from starjax.core.types import Pose

# Found by a search over trocars, bites and directions for the least wrist angles: angle
# on the arc; turn of the jaws about the wire, and in the pads' plane (rad).
GRASP_ANGLE = float(np.deg2rad(-35.0))
GRASP_TURN = float(np.deg2rad(120.0))
GRASP_LEAN = float(np.deg2rad(60.0))


def grasp(
    size: Needle, a: float = GRASP_ANGLE, turn: float = GRASP_TURN, lean: float = GRASP_LEAN
) -> Pose:
    """Returns pose_tip_needle of a grasp at the angle `a` on the arc (all rad)."""
    out = np.array([np.cos(a), np.sin(a), 0.0])
    along = np.array([-np.sin(a), np.cos(a), 0.0])
    z = np.cos(turn) * np.array([0.0, 0.0, -1.0]) - np.sin(turn) * out
    x, z = np.cos(lean) * along - np.sin(lean) * z, np.cos(lean) * z + np.sin(lean) * along
    R_tip_needle = np.stack([x, np.cross(z, x), z])
    held = size.radius * out + np.array([size.centre, 0.0, 0.0])
    return Pose(
        jnp.asarray(R_tip_needle, jnp.float32), jnp.asarray(-R_tip_needle @ held, jnp.float32)
    )
