"""Grasps of a needle's point that turn it out of the pad, at every trocar.

A needle leaves the pad by 150 degrees of turn, and the wrist has 80 either way: its point is taken
twice. The turn of the jaws about the wire and their lean are free. Both grasps are the best of a
grid of 15 degrees over bites and 112 trocars: wrist angles of at most 76 and 74 degrees, palm and
pads 1 mm clear of the pad, the roll within 116 degrees of its zero.
"""

import jax.numpy as jnp
import numpy as np

from starjax.addons.suture.tissue import needle as needles
from starjax.addons.suture.tissue.needle import Needle
from starjax.core.types import Pose

FROM_POINT = 0.002  # m of wire from the point to the jaws' middle
# Turns of the jaws about the wire, and their leans in the pads' plane, rad, of both grasps.
TURNS = (float(np.deg2rad(210.0)), float(np.deg2rad(90.0)))
LEANS = (float(np.deg2rad(-75.0)), float(np.deg2rad(-15.0)))
# Half a turn of the jaws changes nothing but the roll.
HALF_TURN = np.diag([-1.0, -1.0, 1.0]).astype(np.float32)
POSTURES = (HALF_TURN, np.eye(3, dtype=np.float32))


def grasps(size: Needle) -> Pose:
    """Returns pose_tip_needle `[2]` of jaws at the point, the first and the second grasp."""
    angle = jnp.asarray(size.end - FROM_POINT / size.radius)
    offset = needles.offset_at(size, angle)
    a = float(size.end - FROM_POINT / size.radius)
    out, along = np.array([np.cos(a), np.sin(a), 0.0]), np.array([-np.sin(a), np.cos(a), 0.0])
    rotations = []
    for turn, lean, posture in zip(TURNS, LEANS, POSTURES, strict=True):
        z = np.cos(turn) * np.array([0.0, 0.0, -1.0]) - np.sin(turn) * out
        x, z = np.cos(lean) * along - np.sin(lean) * z, np.cos(lean) * z + np.sin(lean) * along
        rotations.append(posture @ np.stack([x, np.cross(z, x), z]))
    R = jnp.asarray(np.stack(rotations), jnp.float32)
    return Pose(R, -R @ offset)
