"""The start of a plan: how far its first command is from the tool, and a way there where it is far.

A tool that has just been passed through the trocar is shallower than any that a demonstration
shows. There a policy commands the nearest tips that it knows, 90 mm away, at once. So such plans
are replaced by a slow straight way on the RCM manifold to their first command.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.spatial.transform import Rotation

from starjax import rcm
from starjax.data import normalizer
from starjax.rcm import arrays
from starjax.types import Command, Pose

# The packaged policy's first commands are at most 2.8 mm and 0.14 rad from the measured pose (110
# decisions of four simulated trials). A plan that begins so near needs no way there; the default
# bounds are three and two times that.
NEAR_MOVE = 0.003  # m
NEAR_TURN = 0.15  # rad
MAX_FIRST_MOVE = 0.01  # m
MAX_FIRST_TURN = 0.3  # rad
# Of a control step on the way: 3 cm/s, about as fast as demonstrations are half of the time.
APPROACH_MOVE = 0.001  # m
APPROACH_TURN = 0.02  # rad
# Share of half the demonstrated range, beyond which a tip lies outside: commands end at the range's
# edge, and rounding may put a tip that is there a little beyond.
OUTSIDE = 0.01


class StartOffset(NamedTuple):
    """How far a first command is from the measured pose.

    Attributes:
      move: `[...]` m, of the tip.
      turn: `[...]` rad, of the tool.
    """

    move: jax.Array
    turn: jax.Array


def start_offset(now: Pose, command: Pose) -> StartOffset:
    """Compares a command with the measured pose; both `[...]`."""
    return StartOffset(arrays.norm(command.p - now.p), arrays.norm(_turn(now.R, command.R)))


def with_approach(
    action_space: str,
    stats: normalizer.Normalizer,
    now: Pose,
    plan: Command,
    told: rcm.TrocarFrame,
) -> Command:
    """Replaces plans that begin far from a shallow tool by a slow way to their start.

    A tool is shallow if its tip lies outside the demonstrated ones and the plan begins deeper. Far
    is beyond `NEAR_MOVE` or `NEAR_TURN`. A tip less deep than `rcm.MIN_DEPTH` is sent there at
    once, as no command is shallower.

    Args:
      action_space: key of `rcm.ACTION_SPACES`, of `stats`.
      now: measured, `[B, A]`.
      plan: `[B, H, A]`.
      told: `[B, A]`.
    """
    begin = jax.tree.map(lambda x: x[:, 0], plan)
    found = start_offset(now, begin.pose)
    is_far = (found.move > NEAR_MOVE) | (found.turn > NEAR_TURN)
    depth, wanted = (rcm.insertion_depth(x, told.p_world_trocar) for x in (now, begin.pose))
    is_led = is_far & (wanted > depth) & _is_unknown(action_space, stats, now, told)
    way = Command(_way(now, begin.pose, told.p_world_trocar, plan.gripper.shape[1]), begin.gripper)

    def chosen(on_the_way: jax.Array, planned: jax.Array) -> jax.Array:
        which = is_led[:, None].reshape(*is_led[:, None].shape, *[1] * (planned.ndim - 3))
        return jnp.where(which, on_the_way, planned)

    way = way._replace(gripper=way.gripper[:, None])
    return jax.tree.map(chosen, way, plan)


def _is_unknown(
    action_space: str, stats: normalizer.Normalizer, now: Pose, told: rcm.TrocarFrame
) -> jax.Array:
    """Whether tips `[B, A]` lie outside the demonstrated ones, in a coordinate or in depth."""
    space = rcm.ACTION_SPACES[action_space]
    encoded = normalizer.encode(action_space, now, jnp.zeros(now.p.shape[:-1]), told)
    scaled = stats.action.normalize(encoded).reshape(*now.p.shape[:-1], space.dim + 1)
    where = space.slices["p"] if "p" in space.slices else space.slices["depth"]
    return (jnp.abs(scaled[..., where]) > 1.0 + OUTSIDE).any(-1)


def _way(now: Pose, begin: Pose, p_world_trocar: jax.Array, steps: int) -> Pose:
    """`[B, steps, A]` poses from `now` to `begin` `[B, A]`, with rotation and depth both straight.

    The tip begins on the measured axis moved into the trocar.
    """
    R = rcm.rot6d_decode(rcm.rot6d_encode(now.R))  # measured ones are rotations up to calibration
    turn = _turn(R, begin.R)
    angle = arrays.norm(turn)
    depth, wanted = (rcm.insertion_depth(x, p_world_trocar) for x in (now, begin))
    swing = angle * jnp.maximum(depth, wanted)  # m, at most, of a tip at this depth
    count = jnp.maximum(angle / APPROACH_TURN, (jnp.abs(wanted - depth) + swing) / APPROACH_MOVE)
    share = jnp.arange(1, steps + 1, dtype=count.dtype)[:, None] / jnp.maximum(count, 1.0)[:, None]
    share = jnp.minimum(share, 1.0)
    turned = arrays.matmul(R[:, None], _rotation(share[..., None] * turn[:, None]))
    deeper = depth[:, None] + share * (wanted - depth)[:, None]
    return rcm.pose_at_depth(turned, deeper, p_world_trocar[:, None])


def _turn(R: jax.Array, other: jax.Array) -> jax.Array:
    """Rotation vectors `[..., 3]` rad, in R's frame, from `R` to `other` `[..., 3, 3]`."""
    return Rotation.from_matrix(arrays.matmul(R.mT, other)).as_rotvec()


def _rotation(turn: jax.Array) -> jax.Array:
    """Rotations `[..., 3, 3]` by rotation vectors `[..., 3]`."""
    return Rotation.from_rotvec(turn).as_matrix()
