"""Trocars: parameters and position (Eq. 1, 2), frame {T}, sampling (Eq. 19), the paper's twelve."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import core
from jax.typing import ArrayLike

from starjax.rcm import arrays, rotations

Range = tuple[float, float]

RADIUS_RANGE: Range = (0.0, 0.05)  # m
POLAR_RANGE: Range = (float(np.deg2rad(70.0)), float(np.deg2rad(110.0)))  # rad, section V-A2
POLAR_RANGE_WIDE: Range = (float(np.deg2rad(60.0)), float(np.deg2rad(120.0)))  # rad, IV-F1
AZIMUTH_RANGE: Range = (0.0, 2.0 * np.pi)  # rad


class Trocar(NamedTuple):
    """Trocar parameters lambda = (r, theta, phi) about the nominal trocar (Eq. 1).

    Attributes:
      radius: `[...]` m, distance from the nominal trocar.
      polar: `[...]` rad, from the world's z axis (up).
      azimuth: `[...]` rad, about the world's z axis.
    """

    radius: Any
    polar: Any
    azimuth: Any


class TrocarFrame(NamedTuple):
    """A resolved trocar: position, orientation of {T} and zero of rolls.

    Attributes:
      trocar: the parameters, fields `[...]`.
      p_world_trocar: `[..., 3]` m (Eq. 2).
      R_world_trocar: `[..., 3, 3]`, see `trocar_rotation`.
      roll_zero: `[...]` rad, the roll that counts as zero. Arms that face each other have zeros
        half a turn apart: neither works at the wrap of its roll.
    """

    trocar: Trocar
    p_world_trocar: Any
    R_world_trocar: Any
    roll_zero: Any


def _degrees(rows: list[tuple[float, float, float]]) -> Trocar:
    centimetres, polar, azimuth = np.array(rows, np.float64).T
    fields = (centimetres / 100.0, np.deg2rad(polar), np.deg2rad(azimuth))
    return Trocar(*(_constant(field.astype(np.float32)) for field in fields))


def _constant(array: np.ndarray) -> np.ndarray:
    array.setflags(write=False)
    return array


# The twelve configurations of section V-A2, `(cm, deg, deg)`. The paper gives their number and
# ranges; unseen are the boundary of every range and its centre.
TROCARS: Trocar = _degrees(
    [
        (4, 80, 0),
        (2, 80, 45),
        (4, 100, 90),
        (2, 100, 135),
        (4, 80, 180),
        (2, 80, 225),
        (4, 100, 270),
        (2, 100, 315),
        (5, 70, 67.5),
        (5, 110, 247.5),
        (5, 90, 157.5),
        (0, 90, 0),
    ]
)
IS_SEEN: np.ndarray = _constant(np.arange(12) < 8)


@arrays.compiled()
def trocar_position(trocar: Trocar, p_world_ref: ArrayLike) -> jax.Array:
    """Returns the position of the trocar in the world frame (Eq. 2).

    Args:
      trocar: fields `[...]`.
      p_world_ref: `[..., 3]` m, the nominal trocar o_ref.

    Returns:
      `[..., 3]` m, p_world_trocar.
    """
    radius, polar, azimuth, p_world_ref = arrays.checked(
        **named_fields(trocar), p_world_ref=(p_world_ref, (3,))
    )
    cos_polar, sin_polar = rotations.cos_sin(polar)  # reduced first: float32 loses huge angles
    cos_azimuth, sin_azimuth = rotations.cos_sin(azimuth)
    offset = jnp.stack(
        jnp.broadcast_arrays(
            radius * (sin_polar * cos_azimuth),
            radius * (sin_polar * sin_azimuth),
            radius * cos_polar,
        ),
        axis=-1,
    )
    return p_world_ref + offset


@arrays.compiled()
def trocar_from_position(p_world_trocar: ArrayLike, p_world_ref: ArrayLike) -> Trocar:
    """Returns the parameters of a trocar measured in the world frame: Eq. 2 solved for lambda.

    Undefined angles are as in `TROCARS`: at the nominal trocar the polar angle is pi/2; there, and
    straight above and below, the azimuth is 0. That azimuth turns {T}.

    Args:
      p_world_trocar: `[..., 3]` m.
      p_world_ref: `[..., 3]` m, the nominal trocar o_ref.

    Returns:
      Fields `[...]`, the azimuth in [0, 2 pi]; NaN where a position is not finite.
    """
    p_world_trocar, p_world_ref = arrays.checked(
        p_world_trocar=(p_world_trocar, (3,)), p_world_ref=(p_world_ref, (3,))
    )
    offset = p_world_trocar - p_world_ref
    unknown = arrays.taint(offset)
    offset = jnp.where(jnp.isfinite(unknown), offset, unknown)
    radius, across = arrays.norm(offset), arrays.norm(offset[..., :2])  # r, r sin(theta)
    x, y, z = (offset[..., i] for i in range(3))
    # Here arctan2 has no derivative or an unbounded one.
    is_ref, is_above = (length <= arrays.epsilon(offset.dtype) for length in (radius, across))
    # arctan2 keeps its digits at the poles, unlike arccos(z / r).
    polar = jnp.arctan2(jnp.where(is_ref, 1.0, across), z)
    azimuth = jnp.arctan2(jnp.where(is_above, 0.0, y), jnp.where(is_above, 1.0, x))
    return Trocar(radius, polar, jnp.where(azimuth < 0.0, azimuth + 2.0 * np.pi, azimuth))


@arrays.compiled()
def trocar_rotation(trocar: Trocar) -> jax.Array:
    """Returns R_world_trocar `[..., 3, 3]` of {T}: z down, x horizontal along the azimuth."""
    fields = arrays.checked(**named_fields(trocar))
    azimuth = jnp.broadcast_arrays(*fields)[2]
    cos, sin = rotations.cos_sin(azimuth)
    zero = jnp.zeros_like(cos)
    # Columns x, y, z of {T}: gravity-aligned, as the paper's, and turned about it by the azimuth
    # phi.
    rows = ([cos, sin, zero], [sin, -cos, zero], [zero, zero, zero - 1.0])
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


@arrays.compiled()
def trocar_frame(trocar: Trocar, p_world_ref: ArrayLike, roll_zero: ArrayLike = 0.0) -> TrocarFrame:
    """Resolves a trocar (Eq. 2 and frame {T}).

    Args:
      trocar: fields `[...]`.
      p_world_ref: `[..., 3]` m, the nominal trocar o_ref.
      roll_zero: `[...]` rad, see `TrocarFrame`.

    Returns:
      All fields with the same leading axes `[...]`.
    """
    fields = arrays.checked(
        **named_fields(trocar), p_world_ref=(p_world_ref, (3,)), roll_zero=(roll_zero, ())
    )
    *scalars, p_world_ref, roll_zero = fields
    shapes = [x.shape for x in (*scalars, roll_zero)]
    shape = jnp.broadcast_shapes(*shapes, p_world_ref.shape[:-1])
    trocar = Trocar(*(jnp.broadcast_to(x, shape) for x in scalars))
    p = trocar_position(trocar, p_world_ref)
    return TrocarFrame(trocar, p, trocar_rotation(trocar), jnp.broadcast_to(roll_zero, shape))


@arrays.broadcasting
def sample_trocar(
    key: jax.Array,
    shape: tuple[int, ...] = (),
    *,
    radius_range: Range = RADIUS_RANGE,
    polar_range: Range = POLAR_RANGE,
    azimuth_range: Range = AZIMUTH_RANGE,
) -> Trocar:
    """Draws trocars, each parameter uniform in its range (Eq. 19).

    Args:
      key: random key, consumed.
      shape: of every field of the result.
      radius_range: m.
      polar_range: rad; `POLAR_RANGE_WIDE` is the paper's other one.
      azimuth_range: rad.

    Raises:
      ValueError: a range is not finite or not ordered, a radius is negative, or a polar angle
        lies outside [0, pi].
    """
    radius_range = _checked_range("radius_range", radius_range, 0.0, np.inf)
    polar_range = _checked_range("polar_range", polar_range, 0.0, np.pi)
    azimuth_range = _checked_range("azimuth_range", azimuth_range, -np.inf, np.inf)
    key_radius, key_polar, key_azimuth = jax.random.split(key, 3)
    return Trocar(
        radius=_uniform(key_radius, shape, radius_range),
        polar=_uniform(key_polar, shape, polar_range),
        azimuth=_uniform(key_azimuth, shape, azimuth_range),
    )


@arrays.broadcasting
def check_trocar(trocar: Trocar) -> Trocar:
    """Validates a concrete trocar and returns it; traced values pass.

    Raises:
      ValueError: shapes do not broadcast, a value is not finite, the radius is negative, or the
        polar angle lies outside [0, pi].
    """
    arrays.checked(**named_fields(trocar))
    limits = {"radius": (0.0, np.inf), "polar": (0.0, np.pi), "azimuth": (-np.inf, np.inf)}
    for name, (low, high) in limits.items():
        field = getattr(trocar, name)
        if isinstance(field, core.Tracer):
            continue
        value = np.asarray(field, np.float64)
        # One float32 rounding of pi is allowed.
        is_bad = ~np.isfinite(value) | (value < low) | (value > high * (1.0 + 1e-6))
        if is_bad.any():
            raise ValueError(
                f"trocar.{name}: expected finite values in [{low:g}, {high:g}], "
                f"got {value[is_bad].flat[0]:g}"
            )
    return trocar


def named_fields(trocar: Trocar) -> dict[str, tuple[Any, tuple[int, ...]]]:
    return {
        "trocar.radius": (trocar.radius, ()),
        "trocar.polar": (trocar.polar, ()),
        "trocar.azimuth": (trocar.azimuth, ()),
    }


def _uniform(key: jax.Array, shape: tuple[int, ...], bounds: Range) -> jax.Array:
    return jax.random.uniform(key, shape, minval=bounds[0], maxval=bounds[1])


def _checked_range(name: str, bounds: Range, low: float, high: float) -> Range:
    values = np.asarray(bounds, np.float64)
    is_range = values.shape == (2,) and bool(np.isfinite(values).all() and values[0] <= values[1])
    if not (is_range and values[0] >= low and values[1] <= high * (1.0 + 1e-6)):
        raise ValueError(
            f"{name}: expected (low, high), finite and ordered, in [{low:g}, {high:g}], "
            f"got {bounds}"
        )
    return float(values[0]), float(values[1])
