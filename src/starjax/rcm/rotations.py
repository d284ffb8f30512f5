"""Rotations the RCM maps are built from: alignment (Eq. 16), axial roll, 6-D representation.

Everything broadcasts over leading axes, is defined for every finite input and has finite
derivatives there. `R_a_b` takes coordinates in frame b to coordinates in frame a.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from starjax.rcm import arrays

# World to the fixed-yaw frame whose z points down, G = diag(1, -1, -1); it is its own inverse.
_DOWN = np.array([1.0, -1.0, -1.0], np.float32)
# Bound of a matrix' entries: their squares stay finite.
_MOST_ENTRY = 1e9
_E_X = np.array([1.0, 0.0, 0.0], np.float32)
_E_Y = np.array([0.0, 1.0, 0.0], np.float32)
_E_Z = np.array([0.0, 0.0, 1.0], np.float32)


@arrays.compiled()
def rotation_align(a: ArrayLike, b: ArrayLike) -> jax.Array:
    """Returns the smallest rotation that turns the direction of `a` into that of `b` (Eq. 16).

    Eq. 16 divides by `1 + a.b`, which cancels as `b` nears `-a`. Here the part of `b` across `a`
    spans the plane of rotation; for an obtuse angle it is made orthogonal to `a` again before it is
    scaled up. At `b = -a` (to within `epsilon`) the plane is undefined; the rotation is then half a
    turn about a fixed axis, x for `a = e_z`.

    Args:
      a: `[..., 3]`, of any length: below 5e-7 (1e-12 in float64) it counts as zero, and zero as
        e_z. Non-finite entries count as zero.
      b: `[..., 3]`, likewise.

    Returns:
      `[..., 3, 3]` rotations `R` with `R a = b` (for unit vectors).
    """
    a, b = arrays.checked(a=(a, (3,)), b=(b, (3,)))
    a, _ = arrays.direction(arrays.bounded(a), _E_Z)
    b, _ = arrays.direction(arrays.bounded(b), _E_Z)
    return _align_unit(a, b)


def _align_unit(a: jax.Array, b: jax.Array) -> jax.Array:
    cos = arrays.dot(a, b)  # a . b, [.., 1]
    across = b - cos * a  # sin(angle) times a unit vector orthogonal to a
    in_plane, sin = arrays.direction(across, _orthogonal(a))
    in_plane = in_plane - arrays.dot(in_plane, a) * a  # again: near b = -a rounding dominates
    in_plane, _ = arrays.direction(in_plane, _orthogonal(a))
    # Rodrigues in the plane (a, b): R = I + (w a' - a w') - (1 - cos)(a a' + e e'), with e the unit
    # vector across a and w = sin e. Acute: (1 - cos) e e' = w w' / (1 + cos), the factor of
    # Eq. 16, without a division by sin. Obtuse: (1 - cos) e e' with e re-orthogonalised.
    is_obtuse = cos < 0.0
    w = jnp.where(is_obtuse, sin[..., None] * in_plane, across)
    spanning = jnp.where(is_obtuse, in_plane, across)
    factor = jnp.where(is_obtuse, 1.0 - cos, 1.0 / (1.0 + jnp.where(is_obtuse, 0.0, cos)))
    # Eq. 16 with k = a x b: [k]x = w a' - a w', [k]x^2 = -(1 - cos^2)(a a' + e e').
    eye = jnp.eye(3, dtype=a.dtype)
    turn = _outer(w, a) - _outer(a, w)
    return eye + turn - _outer((1.0 - cos) * a, a) - _outer(factor * spanning, spanning)


@arrays.compiled()
def rotation_z(angle: ArrayLike) -> jax.Array:
    """Returns the rotation `[..., 3, 3]` by `angle` `[...]` rad about the z axis."""
    (angle,) = arrays.checked(angle=(angle, ()))
    cos, sin = cos_sin(angle)
    zero, one = jnp.zeros_like(cos), jnp.ones_like(cos)
    rows = ([cos, -sin, zero], [sin, cos, zero], [zero, zero, one])
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def cos_sin(angle: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns cosine and sine of `angle` `[...]` rad, reduced by whole turns for huge angles."""
    angle = jax.lax.rem(angle, jnp.asarray(2.0 * np.pi, angle.dtype))
    return jnp.cos(angle), jnp.sin(angle)


@arrays.compiled()
def rotation_from_axis_roll(axis_world: ArrayLike, roll: ArrayLike) -> jax.Array:
    """Returns the tool rotation with a given axis and roll (Alg. 1, lines 3-6).

    `R_world_tip = G @ align(e_z, G' @ axis_world) @ R_z(roll)` with G = diag(1, -1, -1): the
    base rotation is taken from a z-down frame of fixed yaw. Alg. 1 reads as if it were taken
    from the world's up-axis, which is singular where every laparoscopic tool points. The
    singular direction is here a tool that points straight up.

    Args:
      axis_world: `[..., 3]` tool axis, distal, of any length: below 5e-7 (1e-12 in float64) it
        counts as straight down.
      roll: `[...]` rad.

    Returns:
      `[..., 3, 3]` R_world_tip, whose third column is the unit axis.
    """
    axis_world, roll = arrays.checked(axis_world=(axis_world, (3,)), roll=(roll, ()))
    base = _base_rotation(axis_world)
    cos, sin = (value[..., None] for value in cos_sin(roll))
    x, y, z = base[..., :, 0], base[..., :, 1], base[..., :, 2]
    x, y, z = jnp.broadcast_arrays(cos * x + sin * y, cos * y - sin * x, z)  # R_base R_z(gamma)
    return jnp.stack([x, y, z], axis=-1)


@arrays.compiled()
def roll_of(R_world_tip: ArrayLike) -> jax.Array:
    """Returns the roll `[...]` in [-pi, pi] rad of R, inverse to `rotation_from_axis_roll`.

    Continuous in R except for a tool that points straight up, and at half a turn; NaN if the first
    or the last column has one.

    Args:
      R_world_tip: `[..., 3, 3]`.
    """
    (R_world_tip,) = arrays.checked(R_world_tip=(R_world_tip, (3, 3)))
    base = _base_rotation(R_world_tip[..., :, 2])
    x = jnp.clip(R_world_tip[..., :, 0], -_MOST_ENTRY, _MOST_ENTRY)
    # R_base' R = R_z(gamma): read off its first column
    cos = arrays.dot(base[..., :, 0], x)[..., 0]
    sin = arrays.dot(base[..., :, 1], x)[..., 0]
    # Invalid rotations can give (0, 0), where arctan2 has no derivative.
    is_degenerate = cos**2 + sin**2 <= arrays.epsilon(x.dtype) ** 2
    roll = jnp.arctan2(sin, jnp.where(is_degenerate, 1.0, cos))
    # `_base_rotation` reads a NaN axis as straight down.
    axis = R_world_tip[..., :, 2]
    return jnp.where(jnp.isnan(axis).any(-1), arrays.taint(axis)[..., 0], roll)


@arrays.compiled()
def rot6d_encode(R: ArrayLike) -> jax.Array:
    """Returns the first two columns of `R` `[..., 3, 3]`, concatenated: `[..., 6]`."""
    (R,) = arrays.checked(R=(R, (3, 3)))
    return jnp.concatenate([R[..., :, 0], R[..., :, 1]], axis=-1)


@arrays.compiled()
def rot6d_decode(rot6d: ArrayLike) -> jax.Array:
    """Builds a rotation from two columns by Gram-Schmidt, for any input.

    Args:
      rot6d: `[..., 6]`, columns of any length and angle; below 5e-7 (1e-12 in float64) they
        count as zero. A first column that is zero counts as e_x; a second one that is zero or
        parallel to the first is replaced by a fixed one orthogonal to it. Non-finite entries
        count as zero.

    Returns:
      `[..., 3, 3]`.
    """
    (rot6d,) = arrays.checked(rot6d=(rot6d, (6,)))
    rot6d = arrays.bounded(rot6d)
    x, _ = arrays.direction(rot6d[..., :3], _E_X)
    spare = _orthogonal(x)
    y, _ = arrays.direction(rot6d[..., 3:], spare)
    # Twice, because the remainder of nearly parallel columns is small and loses orthogonality.
    for _ in range(2):
        y, _ = arrays.direction(y - arrays.dot(x, y) * x, spare)
    return jnp.stack([x, y, jnp.cross(x, y)], axis=-1)  # right-handed by construction


def _base_rotation(axis_world: jax.Array) -> jax.Array:
    """Computes `G @ rotation_align(e_z, G' @ axis_world)`, written out, of `[..., 3]`."""
    axis, _ = arrays.direction(arrays.bounded(axis_world * _DOWN.astype(axis_world.dtype)), _E_Z)
    across, z = axis[..., :2], axis[..., 2]
    unit, sin = arrays.direction(across, _E_Y[:2])  # straight up: half a turn about a fixed axis
    is_obtuse = z < 0.0
    spanning = jnp.where(is_obtuse[..., None], unit, across)
    factor = jnp.where(is_obtuse, 1.0 - z, 1.0 / (1.0 + jnp.where(is_obtuse, 0.0, z)))
    # Equal to `across` up to rounding, but zero for a tool that points straight up.
    across = jnp.where(is_obtuse[..., None], sin[..., None] * unit, across)
    x, y = across[..., 0], across[..., 1]
    u, v = spanning[..., 0], spanning[..., 1]
    shear = factor * u * v
    rows = ([1.0 - factor * u * u, -shear, x], [shear, factor * v * v - 1.0, -y], [x, y, -z])
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def _orthogonal(a: jax.Array) -> jax.Array:
    """Returns a unit vector orthogonal to unit `a`, from the x axis unless `a` is close to it."""
    other = jnp.where(jnp.abs(a[..., :1]) < 0.7, _E_X, _E_Y).astype(a.dtype)
    across = jnp.cross(a, other)
    return across / jnp.sqrt(arrays.dot(across, across))


def _outer(a: jax.Array, b: jax.Array) -> jax.Array:
    return a[..., :, None] * b[..., None, :]
