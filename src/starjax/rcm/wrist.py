"""Instruments with a wrist: shaft, wrist pitch, wrist yaw and tip, in closed form both ways.

Frames: {L} of the shaft, with its origin W on the pitch axis and z along the shaft, distal; the tip
as everywhere, z along the jaws, y the direction of their opening, x the yaw axis. Pitch turns about
y of {L}, yaw about x of the tip. With a the clevis' and b the jaws' length,

    R_shaft_tip = Ry(pitch) Rx(yaw)
    p_shaft_tip = a Ry(pitch) e_z + b R_shaft_tip e_z

A wrist lets any tip pose have its shaft through any trocar, with one pair of angles of a pitch
within a quarter turn (`angles_through`). The limits of the wrist decide which poses are feasible.
Half a turn of the roll with both angles negated turns the tip by half a turn about its z axis.

Singular are a yaw axis that passes through the trocar, which needs a pitch of a quarter turn, and
W at the trocar. Angles and derivatives are finite there as well.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from starjax.core.types import Pose
from starjax.rcm import arrays, manifold, rotations, wrist_checks

_E_Z = np.array([0.0, 0.0, 1.0], np.float32)
MAX_SKEW = 1e-3  # deviation of a requested matrix from a rotation
_FARTHEST = 1e9  # m; bound of offsets from the trocar, whose squares stay finite


class Wrist(NamedTuple):
    """Sizes and limits of an instrument's wrist.

    Attributes:
      clevis: m, from the pitch axis to the yaw axis.
      jaws: m, from the yaw axis to the tip.
      pitch: rad, maximum either way, below pi/2.
      yaw: rad, maximum either way, below pi/2.
    """

    clevis: float
    jaws: float
    pitch: float
    yaw: float


# Clevis and limits: the dVRK's descriptions of the instruments (jhu-dvrk/sawIntuitiveResearchKit,
# share/tool/LARGE_NEEDLE_DRIVER_400006.json and PROGRASP_FORCEPS_420093.json). These end at the yaw
# axis. Jaws: SurRoL's model of the PSM (psm.urdf), of the needle driver; other models of it have
# 9.5 and 10.6 mm. The ProGrasp's are assumed to be as long.
_JAWS = 0.0102
_LIMIT = float(np.deg2rad(80.0))
LARGE_NEEDLE_DRIVER = Wrist(clevis=0.0091, jaws=_JAWS, pitch=_LIMIT, yaw=_LIMIT)
PROGRASP = Wrist(clevis=0.0107, jaws=_JAWS, pitch=_LIMIT, yaw=_LIMIT)


class WristPose(NamedTuple):
    """A tip pose with the wrist that reaches it.

    Attributes:
      pose: pose_world_tip `[...]`.
      wrist: `[..., 2]` rad, pitch and yaw.
      is_feasible: `[...]`, True if the pose is the requested one and its tip below the trocar.
    """

    pose: Pose
    wrist: jax.Array
    is_feasible: jax.Array


@arrays.compiled("wrist")
def tip_of(wrist: Wrist, pose_world_shaft: Pose, angles: ArrayLike) -> Pose:
    """Returns pose_world_tip `[...]` of a shaft and wrist angles.

    Args:
      wrist: sizes.
      pose_world_shaft: `[...]`, of {L}.
      angles: `[..., 2]` rad, pitch and yaw; not limited.
    """
    wrist_checks.check_wrist(wrist)
    R, p, angles = _checked(pose_world_shaft, angles=(angles, (2,)))
    bend = bent(wrist, angles)
    # T_world_tip = T_world_shaft T_shaft_tip
    return Pose(arrays.matmul(R, bend.R), p + arrays.matvec(R, bend.p))


@arrays.compiled("wrist")
def shaft_of(wrist: Wrist, pose_world_tip: Pose, angles: ArrayLike) -> Pose:
    """Returns pose_world_shaft `[...]` of a tip and wrist angles; needs no trocar.

    Args:
      wrist: sizes.
      pose_world_tip: `[...]`.
      angles: `[..., 2]` rad, pitch and yaw; not limited.
    """
    wrist_checks.check_wrist(wrist)
    R, p, angles = _checked(pose_world_tip, angles=(angles, (2,)))
    bend = bent(wrist, angles)
    R = arrays.matmul(R, bend.R.mT)  # R_world_shaft = R_world_tip R_shaft_tip'
    return Pose(R, p - arrays.matvec(R, bend.p))


@arrays.compiled("wrist")
def angles_through(wrist: Wrist, pose_world_tip: Pose, p_world_trocar: ArrayLike) -> jax.Array:
    """Returns the wrist angles that put the shaft through the trocar.

    Args:
      wrist: sizes; its limits do not apply.
      pose_world_tip: `[...]`.
      p_world_trocar: `[..., 3]` m.

    Returns:
      `[..., 2]` rad, pitch and yaw; NaN if an input is not finite.
    """
    wrist_checks.check_wrist(wrist)
    R, p, p_world_trocar = _checked(pose_world_tip, p_world_trocar=(p_world_trocar, (3,)))
    unknown = _taint(R, p, p_world_trocar)
    angles = _angles(wrist, _rotation(R), _offset(p, p_world_trocar))
    return jnp.where(jnp.isfinite(unknown), angles, unknown)


@arrays.compiled("wrist")
def through(wrist: Wrist, pose_world_tip: Pose, p_world_trocar: ArrayLike) -> WristPose:
    """Finds a feasible pose near a tip pose, with the shaft through the trocar and the tip kept.

    A feasible pose is returned unchanged, up to rounding. Otherwise the angles are clipped to the
    limits and the tool turns about the line from the trocar to the tip until its rotation is as
    near as possible: a close, continuous stand-in for the nearest feasible rotation. Tips are moved
    along that line if W would be shallower than `MIN_DEPTH` or the tip deeper than `MAX_DEPTH`.

    Args:
      wrist: sizes and limits.
      pose_world_tip: `[...]`.
      p_world_trocar: `[..., 3]` m.

    Returns:
      WristPose `[...]`; NaN and not feasible if an input is not finite. Matrices other than
      rotations, for example scaled ones, are not feasible.
    """
    wrist_checks.check_wrist(wrist)
    R, p, o = _checked(pose_world_tip, p_world_trocar=(p_world_trocar, (3,)))
    unknown = _taint(R, p, o)
    requested, R, o, offset = R, _rotation(R), arrays.bounded(o), _offset(p, o)
    is_rotation = jnp.max(jnp.abs(requested - R), (-2, -1)) <= MAX_SKEW
    line, length = arrays.direction(offset, -_E_Z)
    is_feasible, angles = _is_feasible(wrist, _angles(wrist, R, offset), length)
    # An infeasible tip near the trocar has its yaw axis before the trocar and angles half a turn
    # off. Its angles are those of the same rotation as deep as a straight wrist must be.
    least = wrist.clevis + wrist.jaws + manifold.MIN_DEPTH
    deep = _angles(wrist, R, jnp.maximum(length, least)[..., None] * line)
    angles = limited(wrist, jnp.where(is_feasible[..., None], angles, deep))
    bend = bent(wrist, angles)
    depth, _ = tip_depth(bend, length)  # the tip's, along the shaft
    # 1. Any shaft whose tip lies on the line: the least turn of the target's.
    R_shaft = arrays.matmul(R, bend.R.mT)
    toward_tip = arrays.matvec(R_shaft, tip_direction(bend, depth))
    align = rotations.rotation_align(toward_tip, line)
    R_shaft = arrays.matmul(align, R_shaft)
    # 2. The turn about the line that maximises tr(turn A), A = R_tip R_target': nearest rotation.
    A = arrays.matmul(arrays.matmul(R_shaft, bend.R), R.mT)
    turn = _about(line, *_best_turn(A, line))
    shaft = shaft_at(arrays.matmul(turn, R_shaft), depth, bend, o)
    tip = tip_of(wrist, shaft, angles)
    is_known = jnp.isfinite(unknown)
    return WristPose(
        Pose(jnp.where(is_known[..., None], tip.R, unknown[..., None]), tip.p + unknown),
        jnp.where(is_known, angles, unknown),
        is_feasible & is_known[..., 0] & is_rotation & (offset[..., 2] < 0.0),
    )


def bent(wrist: Wrist, angles: jax.Array) -> Pose:
    """Returns pose_shaft_tip `[...]` of wrist angles `[..., 2]`."""
    (cos_pitch, sin_pitch), (cos_yaw, sin_yaw) = (
        rotations.cos_sin(angles[..., i]) for i in range(2)
    )
    zero = jnp.zeros_like(cos_pitch)
    rows = (
        [cos_pitch, sin_pitch * sin_yaw, sin_pitch * cos_yaw],
        [zero, cos_yaw, -sin_yaw],
        [-sin_pitch, cos_pitch * sin_yaw, cos_pitch * cos_yaw],
    )
    R = jnp.stack([jnp.stack(row, -1) for row in rows], -2)
    # Direction from the pitch to the yaw axis, in {L}
    clevis = jnp.stack([sin_pitch, zero, cos_pitch], -1)
    return Pose(R, wrist.clevis * clevis + wrist.jaws * R[..., :, 2])  # R = R_y(pitch) R_x(yaw)


def limited(wrist: Wrist, angles: jax.Array) -> jax.Array:
    """Clips angles `[..., 2]` to the limits of the wrist."""
    limits = _limits(wrist, angles)
    return jnp.clip(angles, -limits, limits)


def tip_depth(bend: Pose, length: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns the depth `[...]` m of a tip at `length` from the trocar, along the shaft.

    The second value is True if no bound moved the tip.
    """
    across2 = arrays.dot(bend.p[..., :2], bend.p[..., :2])[..., 0]
    least = bend.p[..., 2] + manifold.MIN_DEPTH  # depth of W
    length = jnp.minimum(length, 2.0 * manifold.MAX_DEPTH)  # huge squares overflow
    room = length**2 - across2  # Pythagoras: the tip's part along the shaft
    depth = jnp.sqrt(jnp.maximum(room, least**2))
    is_reached = (room >= least**2) & (depth <= manifold.MAX_DEPTH)
    return jnp.minimum(depth, manifold.MAX_DEPTH), is_reached


def tip_direction(bend: Pose, depth: jax.Array) -> jax.Array:
    """Returns the unit vector `[..., 3]` in {L} from the trocar to a tip at a depth."""
    across = (bend.p[..., 0], bend.p[..., 1])
    offset = jnp.stack(jnp.broadcast_arrays(*across, depth), -1)
    return arrays.direction(offset, _E_Z)[0]


def _is_feasible(wrist: Wrist, angles: jax.Array, length: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns True for angles and a tip's distance within all limits, and the clipped angles."""
    clipped = limited(wrist, angles)
    _, is_reached = tip_depth(bent(wrist, clipped), length)
    return jnp.all(angles == clipped, -1) & is_reached, clipped


def shaft_at(R: jax.Array, depth: jax.Array, bend: Pose, p_world_trocar: jax.Array) -> Pose:
    """Returns the shaft through the trocar with a tip at a depth along it."""
    insertion = depth - bend.p[..., 2]  # depth of W, the pitch axis
    return Pose(R, p_world_trocar + insertion[..., None] * R[..., :, 2])


def _angles(wrist: Wrist, R: jax.Array, offset: jax.Array) -> jax.Array:
    """Returns the angles of a tip at `offset` from the trocar.

    The pitch axis is orthogonal to the yaw axis x, to the clevis' direction u and to the shaft. So
    the vector v from the trocar to the yaw axis lies in the plane of x and u, and u is orthogonal
    to x.
    """
    x, y, z = (R[..., :, i] for i in range(3))
    v = offset - wrist.jaws * z
    along = arrays.dot(v, x)  # part along the yaw axis: only the pitch makes it
    u, across = arrays.direction(v - along * x, z)  # the clevis' direction, orthogonal to x
    # In the plane of x and u the shaft runs from the trocar to the pitch axis, `clevis` before
    # the end of v.
    pitch = _arctan2(-along[..., 0], across - wrist.clevis)
    # From u to the jaws' z, about x
    yaw = _arctan2(arrays.dot(u, y)[..., 0], arrays.dot(u, z)[..., 0])
    return jnp.stack([pitch, yaw], -1)


def _arctan2(y: jax.Array, x: jax.Array) -> jax.Array:
    """Returns arctan2, zero with zero derivatives at and near the origin."""
    is_degenerate = jnp.maximum(jnp.abs(x), jnp.abs(y)) <= arrays.epsilon(x.dtype)
    return jnp.arctan2(jnp.where(is_degenerate, 0.0, y), jnp.where(is_degenerate, 1.0, x))


def _best_turn(A: jax.Array, line: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns cosine and sine `[...]` of the turn about `line` that brings `A` nearest to I."""
    skew = jnp.stack([A[..., i, j] - A[..., j, i] for i, j in ((1, 2), (2, 0), (0, 1))], -1)
    # tr(turn A) = cos (tr A - n A n) + sin (n . skew A) + constant: greatest at their angle.
    cos = jnp.trace(A, axis1=-2, axis2=-1) - arrays.dot(line, arrays.matvec(A, line))[..., 0]
    sin = arrays.dot(line, skew)[..., 0]
    fallback = np.array([1.0, 0.0, 0.0], np.float32)
    unit, _ = arrays.direction(jnp.stack([cos, sin, jnp.zeros_like(sin)], -1), fallback)
    return unit[..., 0], unit[..., 1]


def _about(axis: jax.Array, cos: jax.Array, sin: jax.Array) -> jax.Array:
    """Returns the rotation about a unit axis `[..., 3]` (Rodrigues)."""
    x, y, z = (axis[..., i] for i in range(3))
    zero = jnp.zeros_like(x)
    K = jnp.stack([jnp.stack(row, -1) for row in ([zero, -z, y], [z, zero, -x], [-y, x, zero])], -2)
    cos, sin = cos[..., None, None], sin[..., None, None]
    outer = axis[..., :, None] * axis[..., None, :]
    return cos * jnp.eye(3, dtype=axis.dtype) + sin * K + (1.0 - cos) * outer  # Rodrigues


def _rotation(R: jax.Array) -> jax.Array:
    return rotations.rot6d_decode(rotations.rot6d_encode(R))


def _offset(p: jax.Array, p_world_trocar: jax.Array) -> jax.Array:
    return jnp.clip(arrays.bounded(p - p_world_trocar), -_FARTHEST, _FARTHEST)


def _limits(wrist: Wrist, angles: jax.Array) -> jax.Array:
    return jnp.stack([jnp.asarray(x, angles.dtype) for x in (wrist.pitch, wrist.yaw)])


def _checked(pose: Pose, **more: tuple[ArrayLike, tuple[int, ...]]) -> list[jax.Array]:
    return arrays.checked(**{"pose.R": (pose.R, (3, 3)), "pose.p": (pose.p, (3,))}, **more)


def _taint(R: jax.Array, *vectors: jax.Array) -> jax.Array:
    """Returns `[..., 1]`: 0 if all inputs are finite, else NaN."""
    taints = [arrays.taint(R.reshape(*R.shape[:-2], 9)), *map(arrays.taint, vectors)]
    return sum(taints[1:], taints[0])
