"""Suture thread: points with fixed distances, outside the contact solver, led by a needle's tail.

Position-based dynamics: points fall and drag, then Newton's method on all distances at once puts
them back. The thread follows: it does not pull on the needle, and it touches neither tools nor
itself, so it makes no knots. It lies on the level of a pad, and may run through a hole in it.
"""

from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from starjax.addons.suture import tridiagonal
from starjax.sim import iteration

POINTS = 32
LENGTH = 0.150  # m
LINK = LENGTH / (POINTS - 1)  # m
RADIUS = 0.00015  # m, of a suture of size 2-0
GRAVITY = 9.81  # m/s^2
DRAG = 8.0  # 1/s, of the air: 0.1 g/m of thread falls at about 1 m/s
FRICTION = 0.5  # on the pad; assumed
STEPS = 4  # per control period
TOLERANCE = 1e-3  # relative, of links
ITERATIONS = 6  # for Newton's method, at most
MAX_BEND = 0.7  # rad between links, a radius of 7 mm: a thread is stiff; assumed
# Relative: a taut thread between two fixed points has one link more than it needs.
COMPLIANCE = 1e-3
DIP = 0.002  # m below the pad's surface, of the thread half way through the hole
SLOPE = 0.8  # sine of the angle at which a laid thread comes down

OUTSIDE, INSIDE, THROUGH = range(3)  # places of the tail


@flax.struct.dataclass
class Thread:
    """A thread at one moment.

    Attributes:
      p: `[POINTS, 3]` m, the first one at the needle's tail. v: `[POINTS, 3]` m/s.
      place: int32, of the tail: outside, inside the pad, or through it.
      passed: m of thread beyond the entry. It never falls: the hole holds a slack thread.
    """

    p: jax.Array
    v: jax.Array
    place: jax.Array
    passed: jax.Array


class Hole(NamedTuple):
    """A way through the pad.

    Attributes:
      entry, exit: `[3]` m, on the surface.
      is_open: `[]` bool, the needle's point has come out.
    """

    entry: Any
    exit: Any
    is_open: Any


NO_HOLE = Hole(np.zeros(3, np.float32), np.ones(3, np.float32), np.zeros((), bool))


def laid(tail: jax.Array, heading: jax.Array, curl: jax.Array, ground: float) -> Thread:
    """Lays a thread at rest: from the tail down to the pad, and on it along a circle.

    Args:
      tail: `[3]` m, above the ground.
      heading: rad, direction in which it leaves the tail. curl: 1/m, curvature of the circle.
      ground: m, height of the pad's surface.
    """
    z = jnp.maximum(tail[2] - SLOPE * LINK * jnp.arange(POINTS), ground)
    run = jnp.sqrt(LINK**2 - jnp.diff(z) ** 2)
    angle = heading + curl * LINK * jnp.arange(POINTS - 1)
    steps = run[:, None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], -1)
    xy = tail[:2] + jnp.concatenate([jnp.zeros((1, 2)), jnp.cumsum(steps, 0)])
    p = jnp.concatenate([xy, z[:, None]], -1)
    return Thread(p, jnp.zeros_like(p), jnp.zeros((), jnp.int32), jnp.zeros(()))


def advance(thread: Thread, tail: jax.Array, hole: Hole, ground: float, period: float) -> Thread:
    """Advances the thread by `period` s, while the tail moves straight on to `tail` `[3]` m."""
    start = thread.p[0]

    def one(i: jax.Array, thread: Thread) -> Thread:
        at = start + (i + 1) / STEPS * (tail - start)
        return step(thread, at, hole, ground, period / STEPS)

    return jax.lax.fori_loop(0, STEPS, one, thread)


def step(thread: Thread, tail: jax.Array, hole: Hole, ground: float, h: float) -> Thread:
    """Advances the thread by one step of `h` s, its first point at `tail` `[3]` m."""
    thread = _pulled(thread, tail, hole, ground)
    fixed, at = _fixed(thread, tail, hole)
    v = (thread.v - jnp.array([0.0, 0.0, GRAVITY * h])) / (1.0 + DRAG * h)
    p = jnp.where(fixed, at, _on_pad(thread.p, _unbent(thread.p + h * v), ground))
    floor = jnp.where(fixed, -jnp.inf, ground)
    free = jnp.where(fixed[:, 0], 0.0, 1.0)

    def is_off(p: jax.Array) -> jax.Array:
        return _worst(p, free) > TOLERANCE

    def improve(p: jax.Array) -> jax.Array:
        return _spaced(p, free).at[:, 2].max(floor[:, 0])

    p = iteration.improve_while(is_off, improve, p, ITERATIONS)
    return thread.replace(p=p, v=(p - thread.p) / h)


def lengths(p: jax.Array) -> jax.Array:
    """Returns the links' lengths `[POINTS - 1]` m."""
    return jnp.sqrt(jnp.sum(jnp.diff(p, axis=0) ** 2, -1))


def channel(hole: Hole) -> jax.Array:
    """Returns the length of thread inside the pad, m."""
    return 2.0 * jnp.sqrt(0.25 * jnp.sum((hole.exit - hole.entry) ** 2) + DIP**2)


def _pulled(thread: Thread, tail: jax.Array, hole: Hole, ground: float) -> Thread:
    """Returns the thread with the tail's place, and as much of it passed as a taut one needs."""
    before, after = (jnp.sqrt(jnp.sum((tail - x) ** 2)) for x in (hole.entry, hole.exit))
    is_under = tail[2] < ground
    place = jnp.where(hole.is_open & is_under & (thread.place == OUTSIDE), INSIDE, thread.place)
    came_out = jnp.where(after < before, THROUGH, OUTSIDE)
    place = jnp.where(~is_under & (place == INSIDE), came_out, place).astype(jnp.int32)
    inside = channel(hole)
    share = before / jnp.maximum(before + after, LINK)
    passed = jnp.where(place == INSIDE, share * inside, 0.0)
    passed = jnp.where(place == THROUGH, inside + after, passed)
    passed = jnp.where(place == OUTSIDE, 0.0, jnp.maximum(passed, thread.passed))
    return thread.replace(place=place, passed=passed)


def _fixed(thread: Thread, tail: jax.Array, hole: Hole) -> tuple[jax.Array, jax.Array]:
    """Returns the points whose position is given, bool `[POINTS, 1]`, and that `[POINTS, 3]` m."""
    along = LINK * jnp.arange(POINTS)[:, None]  # m of thread from the tail
    inside = channel(hole)
    share = (thread.passed - along) / inside  # part of the way through the pad
    is_inside = (thread.place != OUTSIDE) & (share > 0.0) & (share < 1.0)
    depth = DIP * (1.0 - jnp.abs(2.0 * share - 1.0))
    at = hole.entry + share * (hole.exit - hole.entry) - depth * jnp.array([0.0, 0.0, 1.0])
    is_tail = np.arange(POINTS)[:, None] == 0
    return is_tail | is_inside, jnp.where(is_tail, tail, at)


def _unbent(p: jax.Array) -> jax.Array:
    """Returns points `[POINTS, 3]` with a quarter of each bend beyond the largest undone."""
    bend = 0.5 * (p[:-2] + p[2:]) - p[1:-1]
    size = jnp.sqrt(jnp.sum(bend**2, -1, keepdims=True))
    beyond = jnp.maximum(1.0 - LINK * np.sin(MAX_BEND / 2) / jnp.maximum(size, 1e-9), 0.0)
    move = 0.125 * beyond * bend  # by the neighbours, twice that of the middle: the mean stays
    return p.at[1:-1].add(2.0 * move).at[:-2].add(-move).at[2:].add(-move)


def _on_pad(before: jax.Array, p: jax.Array, ground: float) -> jax.Array:
    """Returns points `[POINTS, 3]` above the pad, those that fell into it held by its friction."""
    sunk = jnp.maximum(ground - p[:, 2:], 0.0)
    slide = (p - before)[:, :2]
    size = jnp.sqrt(jnp.sum(slide**2, -1, keepdims=True))
    kept = jnp.maximum(1.0 - FRICTION * sunk / jnp.maximum(size, 1e-12), 0.0)
    xy = before[:, :2] + kept * slide
    return jnp.concatenate([xy, p[:, 2:] + sunk], -1)


def _worst(p: jax.Array, free: jax.Array) -> jax.Array:
    """Returns the largest relative error of a link that has a free end."""
    off = jnp.abs(lengths(p) / LINK - 1.0)
    return jnp.max(jnp.where(free[:-1] + free[1:] > 0.0, off, 0.0))


def _spaced(p: jax.Array, free: jax.Array) -> jax.Array:
    """Returns points moved as little as their distances need, to first order; `free` `[POINTS]`."""
    link = jnp.diff(p, axis=0)
    length = jnp.sqrt(jnp.maximum(jnp.sum(link**2, -1), (1e-3 * LINK) ** 2))
    n = link / length[:, None]
    # (J W J' + compliance) x = error, tridiagonal: link i shares a point with i - 1 and i + 1.
    middle = free[:-1] + free[1:]
    side = -free[1:-1] * jnp.sum(n[:-1] * n[1:], -1)
    lower, upper = jnp.pad(side, (1, 0)), jnp.pad(side, (0, 1))
    error = jnp.where(middle > 0.0, length - LINK, 0.0)
    x = tridiagonal.solve(lower, middle + COMPLIANCE, upper, error)
    pull = x[:, None] * n
    return p + free[:, None] * (jnp.pad(pull, ((0, 1), (0, 0))) - jnp.pad(pull, ((1, 0), (0, 0))))
