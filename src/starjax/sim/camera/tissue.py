"""Look of a body cavity: wet tissue with vessels and fat instead of the checkered ground.

Textures are functions of the point on the ground, without a stored image: sums of sines for its
relief, and bands about the zeros of warped sines for vessels. The lamp sits next to the lens and
moves with it; its light falls off with the distance and towards the edge of its cone.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp

from starjax.core.types import Array

NAME = "tissue"

# Waves of the relief: direction in rad, length in mm, slope, phase.
_FOLDS = (
    (0.3, 61.0, 0.28, 0.0), (1.5, 47.0, 0.24, 1.3), (2.6, 29.0, 0.20, 4.1),
    (0.9, 17.0, 0.14, 2.2), (2.1, 11.0, 0.12, 5.0), (0.1, 6.1, 0.10, 0.7), (1.8, 4.3, 0.08, 3.3),
)  # fmt: skip
# Vessels: direction in rad, distance between two in mm, half-width in mm, phase, RGB.
_VESSELS = (
    (0.5, 41.0, 0.9, 0.4, (0.40, 0.16, 0.30)), (2.3, 53.0, 1.1, 2.0, (0.42, 0.05, 0.07)),
    (1.2, 27.0, 0.35, 1.1, (0.52, 0.08, 0.09)), (2.9, 22.0, 0.3, 0.2, (0.50, 0.10, 0.10)),
)  # fmt: skip
_WARP = ((1.1, 37.0, 7.0, 0.9), (2.7, 23.0, 4.0, 2.4), (0.4, 9.0, 0.6, 4.4))  # as folds, mm aside
_FLESH, _DEEP, _FAT = (0.84, 0.42, 0.38), (0.60, 0.20, 0.20), (0.92, 0.72, 0.45)
_INK = 0.65  # opacity of a vessel over the flesh
_CAVITY = (0.13, 0.03, 0.03)  # RGB of rays that miss the ground
_FAT_FROM, _FAT_TO = 0.45, 0.8  # values of the sum of the slow waves, -1 to 1: edge of fat
_LAMP = (0.004, 0.002, 0.0)  # m from the lens: right, up, back
_AMBIENT, _DIFFUSE, _WET = 0.22, 0.85, 0.55
_WET_EXPONENT = 24.0
_SHADE = 0.6  # part of the diffuse light in a shadow
_CONE = 0.75  # cosine of the angle from the middle of the lamp's cone to its dark edge
_BRIGHTEST = 1.25  # multiple of the light at the middle, nearer to the lamp


class Look(NamedTuple):
    """The changes of a look in one image.

    Attributes:
      paint: (points x, y, z in the camera frame, in shadow) `[T, Q]` each -> red, green and blue
        of the ground.
      lamp: points -> factor of the light of everything else.
      background: RGB of rays without a hit.
    """

    paint: Callable[[Sequence[Any], Any], list[Any]]
    lamp: Callable[[Sequence[Any]], Any]
    background: tuple[float, float, float]


def look(step: float, R_geom_cam: Array, p_geom_lens: Array) -> Look:
    """Makes the look of one camera over the ground.

    Args:
      step: width of a pixel in the plane at depth 1.
      R_geom_cam, p_geom_lens: `[3, 3]` and `[3]` m, the camera's pose in the ground's frame.
    """
    middle = jnp.sqrt(sum(p_geom_lens[k] ** 2 for k in range(3)))  # m, lens to middle of the ground
    aim = [-sum(R_geom_cam[k, i] * p_geom_lens[k] for k in range(3)) / middle for i in range(3)]

    def from_lamp(p: Sequence[Any]) -> tuple[list[Any], Any]:
        """Returns the unit vectors to the lamp, and the lamp's light."""
        way = [_LAMP[i] - p[i] for i in range(3)]
        near = 1.0 / jnp.sqrt(sum(w * w for w in way))
        way = [w * near for w in way]
        cosine = -sum(a * w for a, w in zip(aim, way))
        cone = _smooth((cosine - _CONE) / (1.0 - _CONE))
        return way, jnp.minimum(_BRIGHTEST, (middle * near) ** 2) * (0.25 + 0.75 * cone)

    def paint(p: Sequence[Any], shaded: Array) -> list[Any]:
        at = [
            1e3 * (p_geom_lens[k] + sum(R_geom_cam[k, i] * p[i] for i in range(3)))
            for k in range(2)
        ]
        footprint = 1e3 * step * -p[2]  # mm, width of a pixel
        slope_x, slope_y, height = _relief(at, footprint)
        way, light = from_lamp(p)
        ground = [sum(R_geom_cam[k, i] * way[i] for i in range(3)) for k in range(3)]
        steep = 1.0 / jnp.sqrt(1.0 + slope_x * slope_x + slope_y * slope_y)
        facing = jnp.maximum((ground[2] - slope_x * ground[0] - slope_y * ground[1]) * steep, 0.0)
        # The lamp is next to the lens: the half vector of a reflection is the way to the lamp.
        shine = _WET * facing**_WET_EXPONENT
        diffuse = _AMBIENT + _DIFFUSE * facing * jnp.where(shaded, _SHADE, 1.0)
        rgb = _colours(at, footprint, height)
        return [jnp.clip(light * (diffuse * c + shine), 0.0, 1.0) for c in rgb]

    return Look(paint, lambda p: from_lamp(p)[1], _CAVITY)


def _relief(at: Sequence[Any], footprint: Array) -> tuple[Any, Any, Any]:
    """Returns slopes along x and y, and a height from -1 to 1, at points in mm."""
    slope_x = slope_y = height = 0.0
    for turn, length, slope, phase in _FOLDS:
        x, y = math.cos(turn), math.sin(turn)
        angle = 2 * math.pi / length * (x * at[0] + y * at[1]) + phase
        seen = _smooth(0.5 * length / footprint - 0.5)  # waves thinner than two pixels vanish
        rise = slope * seen * jnp.cos(angle)
        slope_x, slope_y = slope_x + x * rise, slope_y + y * rise
        height = height + jnp.sin(angle) * (length > 20.0) / 3
    return slope_x, slope_y, height


def _colours(at: Sequence[Any], footprint: Array, height: Array) -> list[Any]:
    """Returns the unlit RGB at points in mm."""
    deep = 0.5 - 0.5 * height
    fat = _smooth((height - _FAT_FROM) / (_FAT_TO - _FAT_FROM))
    rgb = [a + (b - a) * deep for a, b in zip(_FLESH, _DEEP)]
    rgb = [c + 0.8 * (f - c) * fat for c, f in zip(rgb, _FAT)]
    aside = 0.0
    for turn, length, reach, phase in _WARP:
        x, y = math.cos(turn), math.sin(turn)
        aside = aside + reach * jnp.sin(2 * math.pi / length * (x * at[0] + y * at[1]) + phase)
    for turn, gap, half, phase, colour in _VESSELS:
        x, y = math.cos(turn), math.sin(turn)
        wave = jnp.sin(math.pi / gap * (x * at[0] + y * at[1] + aside) + phase)
        off = jnp.abs(wave) * gap / math.pi  # mm from the vessel's middle, near it
        soft = 0.5 * half + 0.5 * footprint
        inside = _smooth((half + soft - off) / (2.0 * soft)) * jnp.minimum(
            1.0, 2 * half / footprint
        )
        rgb = [c + _INK * inside * (v - c) for c, v in zip(rgb, colour)]
    return rgb


def _smooth(x: Array | float) -> Any:
    """Returns the smooth step from 0 at 0 to 1 at 1."""
    x = jnp.clip(x, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)
