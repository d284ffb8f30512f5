"""Springs, dampers and dry friction on one light body, integrated implicitly.

A row is a direction in the velocities of the body, u `[6]`: its centre's in the world (m/s) and its
turn in its own frame (rad/s), as MuJoCo's free joint has them. A row with stretch r, stiffness k,
damping c and the other side's velocity w has, at the end of a step h, the force

    -(k (r + h v) + c v),   v = J u - w,

clipped to its bounds. The velocity after the step minimises a convex function, as accelerations do
in `sim.solver`; a body of 0.07 g on springs of 20 kN/m is stable at 1/240 s.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.spatial.transform import Rotation

from starjax.core.types import Pose
from starjax.sim import iteration, linear

MAX_ITERATIONS = 12
ACCURACY = 1e-5  # relative, of the impulses


class ForceRows(NamedTuple):
    """Rows E of forces; one with neither stiffness nor damping is absent.

    Attributes:
      J: `[E, 6]`.
      stretch: `[E]` m (rad). stiffness, damping: `[E]` N/m and N s/m (N m/rad, N m s/rad).
      low, high: `[E]` N (N m), bounds of the force.
      drift: `[E]` m/s (rad/s), of the other side along J.
    """

    J: jax.Array
    stretch: jax.Array
    stiffness: jax.Array
    damping: jax.Array
    low: jax.Array
    high: jax.Array
    drift: jax.Array


def made(
    J: jax.Array,
    stretch: jax.Array,
    stiffness: jax.Array | float,
    damping: jax.Array | float,
    bound: jax.Array | float = jnp.inf,
    drift: jax.Array | float = 0.0,
) -> ForceRows:
    """Returns rows with a bound either way; all but `J` broadcast to `[E]`."""
    values = (stretch, stiffness, damping, -jnp.asarray(bound), bound, drift)
    return ForceRows(J, *(jnp.broadcast_to(jnp.float32(x), J.shape[:-1]) for x in values))


def joined(parts: list[ForceRows]) -> ForceRows:
    """Returns the rows of all parts."""
    return jax.tree.map(lambda *x: jnp.concatenate(x), *parts)


def present(rows: ForceRows, is_present: jax.Array) -> ForceRows:
    """Returns the rows, absent unless `is_present` `[E]`."""
    return rows._replace(
        stiffness=jnp.where(is_present, rows.stiffness, 0.0),
        damping=jnp.where(is_present, rows.damping, 0.0),
    )


def at_point(pose: Pose, p: jax.Array, directions: jax.Array) -> jax.Array:
    """Returns J `[..., 6]` of the body's material at `p` `[3]` m along directions `[..., 3]`."""
    return jnp.concatenate([directions, jnp.cross(p - pose.p, directions) @ pose.R], -1)


def about(pose: Pose, axes: jax.Array) -> jax.Array:
    """Returns J `[..., 6]` of the body's turn about world axes `[..., 3]`."""
    return jnp.concatenate([jnp.zeros_like(axes), axes @ pose.R], -1)


def solve(
    rows: ForceRows, inertia: jax.Array, free: jax.Array, start: jax.Array, h: float
) -> tuple[jax.Array, jax.Array]:
    """Finds the body's velocity after a step, single-sample.

    Args:
      inertia: `[6]` kg, kg m^2, diagonal.
      free: `[6]`, the velocity after the step without the rows. start: `[6]`, a guess.
      h: s.

    Returns:
      the velocity `[6]`; the rows' forces `[E]` N (N m).
    """
    slope = h * (rows.stiffness * h + rows.damping)
    rest = h * rows.stiffness * rows.stretch - slope * rows.drift
    low, high = (jnp.where(slope > 0, h * bound, 0.0) for bound in (rows.low, rows.high))

    def impulses(x: jax.Array) -> jax.Array:
        return jnp.clip(-(rest + slope * x), low, high)

    def gradient(u: jax.Array) -> jax.Array:
        return inertia * (u - free) - impulses(rows.J @ u) @ rows.J

    def is_coarse(u: jax.Array) -> jax.Array:
        p = impulses(rows.J @ u)
        size = jnp.abs(inertia * (u - free)) + jnp.abs(p) @ jnp.abs(rows.J)
        return jnp.any(jnp.abs(gradient(u)) > ACCURACY * size)

    def improve(u: jax.Array) -> jax.Array:
        x, g = rows.J @ u, gradient(u)
        wanted = -(rest + slope * x)
        is_free = (wanted > low) & (wanted < high)
        H = jnp.diag(inertia) + (rows.J.T * jnp.where(is_free, slope, 0.0)) @ rows.J
        step = -linear.solve_positive(H, g)
        first, bend, move = inertia * (u - free) @ step, inertia * step @ step, rows.J @ step

        def slope_at(fraction: jax.Array) -> jax.Array:
            return first + fraction * bend - impulses(x + fraction * move) @ move

        pace = slope * move
        is_moving = pace != 0.0
        bends = (wanted - jnp.stack([low, high])) / jnp.where(is_moving, pace, 1.0)
        bends = jnp.where(is_moving & (bends > 0.0), bends, jnp.inf).reshape(-1)
        return u + line_search(slope_at, g @ step, bends) * step

    u = iteration.improve_while(is_coarse, improve, start, MAX_ITERATIONS)
    return u, impulses(rows.J @ u) / h


def line_search(
    slope: Callable[[jax.Array], jax.Array], first: jax.Array, bends: jax.Array
) -> jax.Array:
    """Finds the minimum of a convex, piecewise quadratic function on the positive axis, exactly.

    If every row slips, a step of Newton's method is as long as the body is light: the minimum
    can lie at a millionth of it, which no fixed set of candidates encloses.

    Args:
      slope: increasing function of a fraction `[]`, linear between the bends.
      first: `[]`, the negative slope at 0.
      bends: `[N]`, where it may bend; infinite ones are absent.

    Returns:
      `[]`.
    """
    is_there = jnp.isfinite(bends)
    values = jax.vmap(slope)(jnp.where(is_there, bends, 0.0))
    falls = values < 0
    low = jnp.max(bends, where=is_there & falls, initial=0.0)
    high = jnp.min(bends, where=is_there & ~falls, initial=jnp.inf)
    # Beyond the last bend any other fraction lies on the same line.
    high = jnp.where(jnp.isfinite(high), high, 2.0 * low + 1.0)
    at_low = jnp.max(values, where=is_there & falls, initial=first)
    rise = slope(high) - at_low
    return low - at_low * (high - low) / jnp.where(rise > 0, rise, jnp.inf)


def rotation(turn: jax.Array) -> jax.Array:
    """Returns the rotation `[3, 3]` of a rotation vector `[3]` rad, also of zero."""
    return Rotation.from_rotvec(turn).as_matrix()
