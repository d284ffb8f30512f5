"""Starts of plans: their distance from the tool, and a slow approach from shallow tools.

A tool that has just been passed through the trocar is shallower than any demonstrated one. A policy
then commands the nearest demonstrated tips at once, 90 mm away. Such a plan is replaced by a slow
straight approach on the RCM manifold to its first command.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from starjax import rcm
from starjax.core.types import Command, Pose
from starjax.data import normalizer
from starjax.deploy import turns
from starjax.rcm import arrays

# The packaged policy's first commands are at most 2.8 mm and 0.14 rad from the measured pose (110
# inferences of four simulated trials): such a plan needs no approach. The default bounds are three
# and two times as large.
NEAR_MOVE = 0.003  # m
NEAR_TURN = 0.15  # rad
MAX_FIRST_MOVE = 0.01  # m
MAX_FIRST_TURN = 0.3  # rad
# Per control step: 3 cm/s, about the median speed of demonstrations.
APPROACH_MOVE = 0.001  # m
APPROACH_TURN = 0.02  # rad
# Margin around the demonstrated range, as a fraction of half of it: commands end at its edge, and
# rounding may put a tip slightly beyond.
OUTSIDE = 0.01


class StartOffset(NamedTuple):
    """Distance from the measured pose to a plan's first command.

    Attributes:
      move: `[...]` m, of the tip.
      turn: `[...]` rad, of the tool.
    """

    move: jax.Array
    turn: jax.Array


def start_offset(measured: Pose, command: Pose) -> StartOffset:
    """Compares a command with the measured pose; both `[...]`."""
    turn = arrays.norm(turns.between(measured.R, command.R))
    return StartOffset(arrays.norm(command.p - measured.p), turn)


def with_approach(
    action_space: str,
    stats: normalizer.Normalizer,
    measured: Pose,
    plan: Command,
    trocar: rcm.TrocarFrame,
) -> Command:
    """Replaces plans that begin far from a shallow tool by a slow approach to their start.

    A tool is shallow if its tip lies outside the demonstrated range and the plan begins deeper. Far
    is beyond `NEAR_MOVE` or `NEAR_TURN`. A tip above `rcm.MIN_DEPTH` first jumps to that depth,
    the least of any command.

    Args:
      action_space: key of `rcm.ACTION_SPACES`, of `stats`.
      measured: `[B, A]`.
      plan: `[B, H, A]`.
      trocar: `[B, A]`.
    """
    begin = jax.tree.map(lambda x: x[:, 0], plan)
    offset = start_offset(measured, begin.pose)
    is_far = (offset.move > NEAR_MOVE) | (offset.turn > NEAR_TURN)
    depth, begin_depth = (
        rcm.insertion_depth(x, trocar.p_world_trocar) for x in (measured, begin.pose)
    )
    is_outside = _is_outside(action_space, stats, measured, trocar)
    replaced = (is_far & (begin_depth > depth) & is_outside)[:, None]
    poses = _approach(measured, begin.pose, trocar.p_world_trocar, plan.gripper.shape[1])

    def choose(approach: jax.Array, planned: jax.Array) -> jax.Array:
        trailing = [1] * (planned.ndim - replaced.ndim)
        return jnp.where(replaced.reshape(*replaced.shape, *trailing), approach, planned)

    return jax.tree.map(choose, Command(poses, begin.gripper[:, None]), plan)


def _is_outside(
    action_space: str, stats: normalizer.Normalizer, measured: Pose, trocar: rcm.TrocarFrame
) -> jax.Array:
    """Returns True for tips `[B, A]` outside the demonstrated range of a coordinate or depth."""
    space = rcm.ACTION_SPACES[action_space]
    encoded = normalizer.encode(action_space, measured, jnp.zeros(measured.p.shape[:-1]), trocar)
    scaled = stats.action.normalize(encoded).reshape(*measured.p.shape[:-1], space.dim + 1)
    coordinates = normalizer.entries_but(space, 1, "R", "roll")
    return (jnp.abs(scaled[..., coordinates]) > 1.0 + OUTSIDE).any(-1)


def _approach(measured: Pose, begin: Pose, p_world_trocar: jax.Array, steps: int) -> Pose:
    """Interpolates rotation and depth linearly from `measured` to `begin` `[B, A]`.

    Returns:
      `[B, steps, A]`, the first of them a step from the measured axis moved into the trocar.
    """
    R = turns.orthonormal(measured.R)
    turn = turns.between(R, begin.R)
    angle = arrays.norm(turn)
    depth, begin_depth = (rcm.insertion_depth(x, p_world_trocar) for x in (measured, begin))
    deeper = begin_depth - depth
    swing = angle * jnp.maximum(depth, begin_depth)  # m, bound of the tip's sideways move
    count = jnp.maximum(angle / APPROACH_TURN, (jnp.abs(deeper) + swing) / APPROACH_MOVE)
    step = jnp.arange(1, steps + 1, dtype=count.dtype)[:, None]
    fraction = jnp.minimum(step / jnp.maximum(count, 1.0)[:, None], 1.0)
    R = turns.part(R[:, None], turn[:, None], fraction)
    depths = depth[:, None] + fraction * deeper[:, None]
    return rcm.pose_at_depth(R, depths, p_world_trocar[:, None])
