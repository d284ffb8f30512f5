"""Motion of one command towards another on the RCM manifold: straight tools, and with a wrist."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from starjax import rcm
from starjax.core.types import Pose
from starjax.deploy import turns
from starjax.rcm import arrays

_TINY = 1e-9  # m and rad, against a division by zero


class ToolMotion(NamedTuple):
    """Compiled functions of poses `[*arms]` and trocars `[*arms, 3]` m.

    Attributes:
      hold: (pose, p_world_trocar) -> the pose with its shaft put through the trocar; the tip stays.
      toward: (last, target, p_world_trocar, max_move, max_turn) -> (the pose towards `target`
        within m and rad of `last`; m and rad, the largest distances of all arms).
      worst: (poses `[H, *arms]`, p_world_trocar) -> (m, the largest distance from the manifold; m,
        the least depth; the largest distance of a matrix from a rotation).
      angles: (pose, p_world_trocar) -> wrist angles `[*arms, 2]` rad, None of straight tools.
    """

    hold: Callable[..., Pose]
    toward: Callable[..., tuple[Pose, jax.Array, jax.Array]]
    worst: Callable[..., tuple[jax.Array, jax.Array, jax.Array]]
    angles: Callable[..., Any]


@jax.jit
@arrays.broadcasting
def _toward(
    last: Pose, target: Pose, p_world_trocar: jax.Array, max_move: float, max_turn: float
) -> tuple[Pose, jax.Array, jax.Array]:
    """Interpolates rotation and depth linearly, so the axis' turn moves the tip sideways."""
    begin, end = (turns.orthonormal(x.R) for x in (last, target))
    depth, end_depth = (rcm.insertion_depth(x, p_world_trocar) for x in (last, target))
    turn = turns.between(begin, end)
    angle = arrays.norm(turn)
    across = jnp.maximum(depth, end_depth) * arrays.norm(turn[..., :2])  # roll moves no tip
    move = arrays.norm(jnp.stack([across, end_depth - depth], -1))
    fraction = jnp.minimum(
        max_move / jnp.maximum(move, _TINY), max_turn / jnp.maximum(angle, _TINY)
    )
    fraction = jnp.minimum(fraction, 1.0)
    R = jnp.where((fraction < 1.0)[..., None, None], turns.part(begin, turn, fraction), end)
    pose = rcm.pose_at_depth(R, depth + fraction * (end_depth - depth), p_world_trocar)
    return pose, jnp.max(move), jnp.max(angle)


@jax.jit
@arrays.broadcasting
def _hold(pose: Pose, p_world_trocar: jax.Array) -> Pose:
    """Turns the tool's axis through the trocar; the tip stays (`rcm.project`)."""
    projected = rcm.project(pose, p_world_trocar)
    depth = rcm.insertion_depth(projected, p_world_trocar)
    return rcm.pose_at_depth(turns.orthonormal(projected.R), depth, p_world_trocar)


@jax.jit
@arrays.broadcasting
def _worst(pose: Pose, p_world_trocar: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    off = rcm.rcm_error(pose, p_world_trocar).max()
    return off, rcm.insertion_depth(pose, p_world_trocar).min(), _skew(pose.R)


STRAIGHT = ToolMotion(_hold, _toward, _worst, lambda pose, p_world_trocar: None)


@functools.lru_cache
def of(wrist: rcm.Wrist | None) -> ToolMotion:
    """Returns the motion of tools with a wrist, or of straight ones.

    With a wrist the tip moves straight, its rotation along the shortest turn, and `rcm.through`
    gives the shaft. A turn is the larger one of the tip and the shaft. Off the manifold are poses
    beyond the wrist's limits, by the way from there to the nearest feasible one.
    """
    if wrist is None:
        return STRAIGHT

    def shaft(pose: Pose, p_world_trocar: jax.Array) -> Pose:
        return rcm.shaft_of(wrist, pose, rcm.angles_through(wrist, pose, p_world_trocar))

    @jax.jit
    @arrays.broadcasting
    def hold(pose: Pose, p_world_trocar: jax.Array) -> Pose:
        return rcm.through(wrist, Pose(turns.orthonormal(pose.R), pose.p), p_world_trocar).pose

    @jax.jit
    @arrays.broadcasting
    def toward(
        last: Pose, target: Pose, p_world_trocar: jax.Array, max_move: float, max_turn: float
    ) -> tuple[Pose, jax.Array, jax.Array]:
        begin, end = (turns.orthonormal(x.R) for x in (last, target))
        turn, way = turns.between(begin, end), target.p - last.p
        shafts = (shaft(x, p_world_trocar) for x in (last, target))
        angle = arrays.norm(turns.between(*(x.R for x in shafts)))
        angle = jnp.maximum(angle, arrays.norm(turn))
        move = arrays.norm(way)
        fraction = jnp.minimum(
            max_move / jnp.maximum(move, _TINY), max_turn / jnp.maximum(angle, _TINY)
        )
        fraction = jnp.minimum(fraction, 1.0)
        R = jnp.where((fraction < 1.0)[..., None, None], turns.part(begin, turn, fraction), end)
        pose = Pose(R, last.p + fraction[..., None] * way)
        return rcm.through(wrist, pose, p_world_trocar).pose, jnp.max(move), jnp.max(angle)

    @jax.jit
    @arrays.broadcasting
    def worst(pose: Pose, p_world_trocar: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        nearest = rcm.through(wrist, pose, p_world_trocar).pose
        turned = jnp.abs(nearest.R - pose.R).max((-2, -1))
        off = arrays.norm(nearest.p - pose.p) + wrist.jaws * turned
        depth = rcm.insertion_depth(shaft(pose, p_world_trocar), p_world_trocar)
        return off.max(), depth.min(), _skew(pose.R)

    @jax.jit
    @arrays.broadcasting
    def angles(pose: Pose, p_world_trocar: jax.Array) -> jax.Array:
        return rcm.angles_through(wrist, pose, p_world_trocar)

    return ToolMotion(hold, toward, worst, angles)


def _skew(R: jax.Array) -> jax.Array:
    """Returns the largest distance of matrices `[..., 3, 3]` from rotations."""
    x, y, z = (R[..., :, i] for i in range(3))
    mirrored = jnp.abs(jnp.cross(x, y) - z).max()
    return jnp.maximum(jnp.abs(arrays.matmul(R.mT, R) - jnp.eye(3)).max(), mirrored)
