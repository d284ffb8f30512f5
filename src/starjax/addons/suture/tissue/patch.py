"""A held needle: a bounded frictional patch between jaws and wire.

Contacts cannot hold a driven needle: a contact is as stiff as 0.07 g of steel lets it be. A patch
is six soft rows between the tip and the needle. Each is bounded by the pads' force, their friction
and size; an excess over a bound slips.
"""

import flax.struct
import jax
import jax.numpy as jnp

from starjax.addons.suture.tissue import needle as needles
from starjax.addons.suture.tissue import rows as bodies
from starjax.addons.suture.tissue.needle import Needle
from starjax.core.types import Pose
from starjax.sim import ik

# N per pad: the torque limit of the dVRK's jaws (0.16 N m, LARGE_NEEDLE_DRIVER_400006.json) over
# both jaws at the tip, 10.2 mm from their axis.
PAD_FORCE = 0.16 / (2 * 0.0102)
# Assumed: friction of serrated pads; half the width of a pad and of the wire's flats, m.
FRICTION, HALF_PAD, HALF_FLAT = 1.2, 0.0018, 0.0006
STIFFNESS, DAMPING = 2e4, 20.0  # N/m, N s/m
TURN_STIFFNESS, TURN_DAMPING = 2.0, 0.002  # N m/rad, N m s/rad
# Box of the tip's frame in which wire is between the pads (m): across them, along the jaws.
REACH = (0.0018, 0.0015, 0.006)


@flax.struct.dataclass
class Patch:
    """State of one patch.

    Attributes:
      pose: pose_tip_needle without load.
      R_tip_patch: `[3, 3]`, x along the wire at the grasp, y across the pads.
      is_held: bool.
    """

    pose: Pose
    R_tip_patch: jax.Array
    is_held: jax.Array


def grasped(needle: Needle, tip: Pose, pose: Pose, is_held: jax.Array) -> Patch:
    """Returns the patch of a needle as it lies in the jaws at `tip`."""
    R = tip.R.T @ pose.R
    angle, _, _ = needles.coordinates(needle, pose, tip.p)
    x = tip.R.T @ needles.tangent_at(pose, angle) * jnp.array([1.0, 0.0, 1.0])  # in the pads' plane
    x = x / jnp.maximum(jnp.linalg.norm(x), 1e-6)
    y = jnp.array([0.0, 1.0, 0.0])
    patch = jnp.stack([x, y, jnp.cross(x, y)], -1)
    return Patch(Pose(R, tip.R.T @ (pose.p - tip.p)), patch, is_held)


def is_between(needle: Needle, tip: Pose, pose: Pose) -> jax.Array:
    """Returns True if wire lies between the pads."""
    angle, _, _ = needles.coordinates(needle, pose, tip.p)
    angle = jnp.clip(angle, -needle.end, needle.end)
    off = tip.R.T @ (needles.point_at(needle, pose, angle) - tip.p)
    return jnp.all(jnp.abs(off) < jnp.array(REACH))


def closed(needle: Needle, patch: Patch, tip: Pose, pose: Pose, gripper: jax.Array) -> Patch:
    """Returns the patch after the jaws' command: it begins where they close on wire."""
    squeezes = gripper < 0.0
    lies = is_between(needle, tip, pose)
    fresh = grasped(needle, tip, pose, squeezes & lies)
    stays = patch.is_held & squeezes & lies
    return jax.tree.map(lambda old, new: jnp.where(stays, old, new), patch, fresh)


def bounds(gripper: jax.Array) -> jax.Array:
    """Returns the largest forces (N) and torques (N m) `[6]` along and about x, y, z of a patch."""
    press = PAD_FORCE * jnp.clip(-gripper, 0.0, 1.0)
    slip = 2.0 * FRICTION * press
    turn = [2.0 * press * HALF_FLAT, slip * HALF_PAD / 2, 2.0 * press * HALF_PAD]
    return jnp.stack([slip, press, slip, *turn])


def rows(
    patch: Patch, tip: Pose, twist: jax.Array, pose: Pose, gripper: jax.Array
) -> tuple[bodies.ForceRows, Patch]:
    """Returns the patch's 6 rows, and the patch after the slip that its bounds cause.

    Args:
      twist: `[6]` m/s and rad/s, of the tip in the world.
    """
    off, turn = _stretch(patch, tip, pose)
    most = bounds(gripper)
    axes = (tip.R @ patch.R_tip_patch).T
    moves, turns = bodies.at_point(pose, tip.p, axes), bodies.about(pose, axes)
    drift = jnp.concatenate([axes @ twist[:3], axes @ twist[3:]])
    found = bodies.joined(
        [
            bodies.made(moves, off, STIFFNESS, DAMPING, most[:3], drift[:3]),
            bodies.made(turns, turn, TURN_STIFFNESS, TURN_DAMPING, most[3:], drift[3:]),
        ]
    )
    held = bodies.present(found, patch.is_held)
    return held, _slipped(patch, off, turn, most)


def _stretch(patch: Patch, tip: Pose, pose: Pose) -> tuple[jax.Array, jax.Array]:
    """Returns the offset `[3]` m of the wire at the grasp, and its turn `[3]` rad, in the patch."""
    turn = ik.rotation_between(patch.pose.R, tip.R.T @ pose.R)
    here = tip.R.T @ (pose.p - tip.p)
    moved = tip.R.T @ pose.R @ patch.pose.R.T @ patch.pose.p
    R = patch.R_tip_patch.T
    return R @ (here - moved), R @ turn


def _slipped(patch: Patch, off: jax.Array, turn: jax.Array, most: jax.Array) -> Patch:
    """Returns the patch moved by the excess over its bounds: there the needle has slipped."""
    give = jnp.sign(off) * jnp.maximum(jnp.abs(off) - most[:3] / STIFFNESS, 0.0)
    twist = jnp.sign(turn) * jnp.maximum(jnp.abs(turn) - most[3:] / TURN_STIFFNESS, 0.0)
    R = bodies.rotation(patch.R_tip_patch @ twist)
    pose = Pose(R @ patch.pose.R, R @ patch.pose.p + patch.R_tip_patch @ give)
    return patch.replace(pose=pose)
