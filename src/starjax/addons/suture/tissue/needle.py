"""Curved suture needles: sizes, the arc in the needle's frame, and the path of a bite.

Needle frame: origin at the centre of mass, the arc in the x-y plane. Angles on the arc are about
its centre: 0 half way, positive towards the point. Lengths in m.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from starjax.core.types import Pose

STEEL = 7900.0  # kg/m^3
SEGMENTS = 7  # straight parts of the drawn and weighed wire
VERTICAL = np.array([0.0, 0.0, 1.0], np.float32)


class Needle(NamedTuple):
    """Sizes of a needle.

    Attributes:
      radius: m, of the arc.
      sweep: rad, of the arc.
      wire: m, radius of the wire.
    """

    radius: float
    sweep: float
    wire: float

    @property
    def centre(self) -> float:
        """x (m) of the arc's centre in the needle's frame, of a wire of straight segments."""
        half = self.sweep / SEGMENTS / 2
        mean = np.sin(self.sweep / 2) / (SEGMENTS * np.sin(half))
        return float(-self.radius * np.cos(half) * mean)

    @property
    def end(self) -> float:
        """Angle (rad) of the point; that of the swage is its opposite."""
        return self.sweep / 2


# Lengths of the makers' lists, 26 and 36 mm along half a circle; wires are assumed.
SH = Needle(radius=0.00828, sweep=float(np.pi), wire=0.00033)
CT1 = Needle(radius=0.01146, sweep=float(np.pi), wire=0.00045)


def offset_at(needle: Needle, angle: jax.Array) -> jax.Array:
    """Returns the position `[3]` m of the wire at an angle, in the needle's frame."""
    out = jnp.stack([jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle)])
    return needle.radius * out + jnp.array([needle.centre, 0.0, 0.0])


def point_at(needle: Needle, pose: Pose, angle: jax.Array) -> jax.Array:
    """Returns the position `[3]` m of the wire at an angle, in the world."""
    return pose.p + pose.R @ offset_at(needle, angle)


def tangent_at(pose: Pose, angle: jax.Array) -> jax.Array:
    """Returns the direction `[3]` of the wire at an angle, towards the point, in the world."""
    return pose.R @ jnp.stack([-jnp.sin(angle), jnp.cos(angle), jnp.zeros_like(angle)])


def coordinates(needle: Needle, pose: Pose, p: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Returns a world position's angle (rad), distance from the arc's axis and height (m)."""
    x, y, z = pose.R.T @ (p - pose.p) - jnp.array([needle.centre, 0.0, 0.0])
    return jnp.arctan2(y, x), jnp.hypot(x, y), z


class Bite(NamedTuple):
    """A planned path through a flat surface, entry and exit `[3]` m, less than a diameter apart."""

    entry: jax.Array
    exit: jax.Array


def entry_angle(needle: Needle, bite: Bite) -> jax.Array:
    """Returns half the turn (rad) between entry and exit.

    The needle's turn counts from the middle of the bite: the point enters at minus this angle.
    """
    half = 0.5 * jnp.linalg.norm(bite.exit - bite.entry)
    return jnp.arcsin(jnp.minimum(half / needle.radius, 1.0))


def pose_on(needle: Needle, bite: Bite, turn: jax.Array, up: ArrayLike = VERTICAL) -> Pose:
    """Returns pose_world_needle on the path of a bite.

    Args:
      turn: rad, of the point about the arc's centre, 0 at its lowest place.
      up: `[3]`, unit vector in the arc's plane, across the line from entry to exit.
    """
    along, up = bite.exit - bite.entry, jnp.asarray(up)
    half = 0.5 * jnp.linalg.norm(along)
    f = along / (2.0 * half)
    height = jnp.sqrt(jnp.maximum(needle.radius**2 - half**2, 0.0))
    y = jnp.sin(turn) * f - jnp.cos(turn) * up
    z = jnp.cross(f, up)
    R = jnp.stack([jnp.cross(y, z), y, z], -1)
    centre = 0.5 * (bite.entry + bite.exit) + height * up
    return Pose(R, centre - R @ jnp.array([needle.centre, 0.0, 0.0]))


def turn_on(needle: Needle, bite: Bite, pose: Pose, up: ArrayLike = VERTICAL) -> jax.Array:
    """Returns the turn (rad) of a needle about the axis of the bite's arc, as of `pose_on`."""
    f = bite.exit - bite.entry
    y = pose.R[:, 1]
    return jnp.arctan2(y @ f / jnp.linalg.norm(f), -(y @ jnp.asarray(up)))
