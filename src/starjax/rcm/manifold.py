"""The RCM manifold: distance from it and depth (Eq. 3), its chart (Eq. 4), projection onto it."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from starjax.core import types
from starjax.rcm import arrays, rotations

MIN_DEPTH = 0.005  # m; shallower poses are moved to this depth along the tool's axis
MAX_DEPTH = 0.4  # m; the longest shaft below the trocar
HOLD_DEPTH = 0.05  # m; of the hold pose

_STRAIGHT_DOWN = np.array([0.0, 0.0, -1.0], np.float32)


@arrays.compiled()
def rcm_error(pose: types.Pose, p_world_trocar: ArrayLike) -> jax.Array:
    """Returns the distance of the trocar from the line of the shaft (Eq. 3).

    Args:
      pose: pose_world_tip `[...]`.
      p_world_trocar: `[..., 3]` m.

    Returns:
      `[...]` m; its derivative on the line, a kink, is zero.
    """
    R, p, p_world_trocar = _checked(pose, p_world_trocar)
    # |(p_E - p_T) x R e_z|: Eq. 3 holds where the cross product is zero.
    return arrays.norm(jnp.cross(p - p_world_trocar, R[..., :, 2]))


@arrays.compiled()
def insertion_depth(pose: types.Pose, p_world_trocar: ArrayLike) -> jax.Array:
    """Returns the signed depth d `[...]` m of the tip beyond the trocar along the axis (Eq. 3)."""
    R, p, p_world_trocar = _checked(pose, p_world_trocar)
    return arrays.dot(p - p_world_trocar, R[..., :, 2])[..., 0]  # d = (p_E - p_T) . R e_z


@arrays.compiled()
def pose_on_manifold(
    axis_world: ArrayLike, roll: ArrayLike, depth: ArrayLike, p_world_trocar: ArrayLike
) -> types.Pose:
    """Returns the pose at coordinates (axis, roll, depth) of the chart S2 x S1 x R (Eq. 4, 18).

    Args:
      axis_world: `[..., 3]` tool axis, distal; a zero vector counts as straight down.
      roll: `[...]` rad.
      depth: `[...]` m, clipped to [MIN_DEPTH, MAX_DEPTH].
      p_world_trocar: `[..., 3]` m.

    Returns:
      pose_world_tip `[...]`.
    """
    R = rotations.rotation_from_axis_roll(axis_world, roll)
    return pose_at_depth(R, depth, p_world_trocar)


@arrays.compiled()
def pose_at_depth(
    R_world_tip: ArrayLike, depth: ArrayLike, p_world_trocar: ArrayLike
) -> types.Pose:
    """Returns the pose of the manifold with a given rotation and depth (Eq. 3).

    The tip is computed from the rotation's own third column, so it lies on the shaft's line to the
    last bit even if the rotation is rounded.

    Args:
      R_world_tip: `[..., 3, 3]`.
      depth: `[...]` m, clipped to [MIN_DEPTH, MAX_DEPTH].
      p_world_trocar: `[..., 3]` m.
    """
    R, depth, p_world_trocar = arrays.checked(
        R_world_tip=(R_world_tip, (3, 3)), depth=(depth, ()), p_world_trocar=(p_world_trocar, (3,))
    )
    # At depth 0 the direction is undefined, and joints would turn infinitely fast.
    depth = jnp.clip(depth, MIN_DEPTH, MAX_DEPTH)[..., None]
    p = p_world_trocar + depth * R[..., :, 2]  # Eq. 3
    return types.Pose(R=jnp.broadcast_to(R, (*p.shape, 3)), p=p)


def axis_and_depth(
    p_world_tip: ArrayLike, p_world_trocar: ArrayLike
) -> tuple[jax.Array, jax.Array]:
    """Splits the way from the trocar to the tip into direction and distance (Alg. 1, line 2).

    Returns:
      `[..., 3]` unit axis, straight down for a tip at the trocar; `[...]` m.
    """
    p, p_world_trocar = arrays.checked(
        p_world_tip=(p_world_tip, (3,)), p_world_trocar=(p_world_trocar, (3,))
    )
    return arrays.direction(p - p_world_trocar, _STRAIGHT_DOWN)


@arrays.compiled()
def project(pose: types.Pose, p_world_trocar: ArrayLike) -> types.Pose:
    """Projects a pose onto the manifold (post hoc, for DP-EE-Proj).

    The tip stays and the tool turns by the smallest rotation that puts its axis through the trocar
    with the tip on the far side (depth positive, Eq. 18). A tip at the trocar is on the manifold
    with any axis: that pose is returned unchanged. A non-finite input makes the whole pose NaN.

    Args:
      pose: pose_world_tip `[...]`.
      p_world_trocar: `[..., 3]` m.

    Returns:
      pose_world_tip `[...]`.
    """
    given = _checked(pose, p_world_trocar)
    R, p, p_world_trocar = given
    # Zero, or NaN where an entry is not finite: added at the end, after safe arithmetic.
    unknown = arrays.taint(R.reshape(*R.shape[:-2], 9)) + arrays.taint(p)
    unknown = unknown + arrays.taint(p_world_trocar)
    R, p, p_world_trocar = (arrays.bounded(x) for x in given)
    # A tip at the trocar keeps its axis
    target, _ = arrays.direction(p - p_world_trocar, R[..., :, 2])
    # Smallest turn about the tip
    R = arrays.matmul(rotations.rotation_align(R[..., :, 2], target), R)
    is_known = jnp.isfinite(unknown)
    return types.Pose(
        R=jnp.where(is_known[..., None], R, unknown[..., None]),
        p=jnp.where(is_known, jnp.broadcast_to(p, R.shape[:-1]), unknown),
    )


def _checked(pose: types.Pose, p_world_trocar: ArrayLike) -> list[jax.Array]:
    return arrays.checked(
        **{"pose.R": (pose.R, (3, 3)), "pose.p": (pose.p, (3,))},
        p_world_trocar=(p_world_trocar, (3,)),
    )
