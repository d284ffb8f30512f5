"""Grasp of a needle's point that can turn the needle out of the pad by a given angle.

No one grasp serves every trocar: a needle leaves the pad by 150 degrees of turn, and the wrist has
80 either way. The turn of the jaws about the wire and their lean are free, so they are searched for
each trocar and bite: the grasp with the least wrist angles, jaws and wrist clear of the pad.
"""

import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.sim.tissue import needle as needles
from starjax.sim.tissue.needle import Bite, Needle
from starjax.sim.tools.needle_driver import TOOL
from starjax.types import Pose

WRIST = rcm.LARGE_NEEDLE_DRIVER
FROM_POINT = 0.002  # m of wire from the point to the jaws' middle
TURNS = np.deg2rad(np.arange(0.0, 360.0, 15.0))  # of the jaws about the wire
LEANS = np.deg2rad(np.arange(-75.0, 76.0, 15.0))  # in the pads' plane
SAMPLES = 7  # of the needle's turn
CLEARANCE = 0.001  # m, of palm and pads above the pad
PENALTY = 500.0  # rad per m of missing clearance
HALF_TURN = np.diag([-1.0, -1.0, 1.0]).astype(np.float32)


def grasp(size: Needle, turn: jax.Array, lean: jax.Array) -> Pose:
    """Returns pose_tip_needle of jaws at the point, turned about the wire and leaning (rad)."""
    angle = jnp.asarray(size.end - FROM_POINT / size.radius)
    zero = jnp.zeros(())
    out = jnp.stack([jnp.cos(angle), jnp.sin(angle), zero])
    along = jnp.stack([-jnp.sin(angle), jnp.cos(angle), zero])
    z = jnp.cos(turn) * jnp.array([0.0, 0.0, -1.0]) - jnp.sin(turn) * out
    x, z = jnp.cos(lean) * along - jnp.sin(lean) * z, jnp.cos(lean) * z + jnp.sin(lean) * along
    R = jnp.stack([x, jnp.cross(z, x), z])
    return Pose(R, -R @ needles.offset_at(size, angle))


def search(
    size: Needle,
    bite: Bite,
    first: jax.Array,
    last: jax.Array,
    p_trocar: jax.Array,
    zero: jax.Array,
) -> Pose:
    """Returns pose_tip_needle of the best grasp.

    Args:
      first, last: rad, turns of the needle on the bite's path.
      p_trocar: `[3]` m.
      zero: rad, the roll next to which the shaft should be.
    """
    path = first + (last - first) * jnp.linspace(0.0, 1.0, SAMPLES)
    on_path = jax.vmap(lambda turn: needles.pose_on(size, bite, turn))(path)

    def cost(turn: jax.Array, lean: jax.Array) -> jax.Array:
        held = grasp(size, turn, lean)
        R = on_path.R @ held.R.T
        tips = Pose(R, on_path.p - R @ held.p)
        angles = rcm.angles_through(WRIST, tips, p_trocar)
        shaft = rcm.shaft_of(WRIST, tips, angles)
        palm = jnp.minimum(shaft.p[:, 2], (tips.p - WRIST.jaws * R[:, :, 2])[:, 2])
        pads = tips.p[:, 2] + TOOL.pad_end * R[:, 2, 2]
        room = jnp.minimum(jnp.min(palm) - TOOL.palm_radius, jnp.min(pads)) - CLEARANCE
        return jnp.max(jnp.abs(angles)) + PENALTY * jnp.maximum(-room, 0.0)

    grid = [jnp.asarray(x.ravel(), jnp.float32) for x in np.meshgrid(TURNS, LEANS)]
    best = jnp.argmin(jax.vmap(cost)(*grid))
    held = grasp(size, grid[0][best], grid[1][best])
    # Half a turn of the jaws changes nothing but the roll.
    middle = jax.tree.map(lambda leaf: leaf[SAMPLES // 2], on_path)
    R = middle.R @ held.R.T
    tip = Pose(R, middle.p - R @ held.p)
    shaft = rcm.shaft_of(WRIST, tip, rcm.angles_through(WRIST, tip, p_trocar))
    is_far = jnp.cos(rcm.roll_of(shaft.R) - zero) < 0.0
    half = jnp.where(is_far, HALF_TURN, jnp.eye(3))
    return Pose(half @ held.R, half @ held.p)
