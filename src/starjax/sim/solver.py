"""Physics step of MJX with a Newton solver of its own for contact forces.

The problem is MuJoCo's (Todorov 2014, "Convex and analytically-invertible dynamics with contacts
and constraints"; MuJoCo's documentation, chapter Computation): the acceleration minimises

    x M x / 2 - f x + sum over constraints of the squared distance of A x - b from a convex set / 2

with A and b the constraint rows times the roots of their stiffnesses. In these units the set of a
contact is a circular cone, for any friction and `impratio`.

MJX's own solver minimises the same function. This one has fewer and larger operations: the line
search evaluates its candidates in parallel, each contact enters the Hessian as three vectors, and
slopes replace costs, since they keep their digits in float32 (`benchmarks/bench_solver.py`).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from starjax.sim import iteration, linear
from starjax.sim.quiet_mjx import mjx

MAX_ITERATIONS = 10
# Largest kinetic energy (J) of the remaining error: an object of 3 g at 0.08 mm/s, an arm's first
# joint at 2 urad/s.
MAX_ERROR_ENERGY = 1e-11
# The scenes that this limit was chosen with have up to so many velocities; in larger ones it grows
# with their number, as rounding errors of all velocities add up.
TUNED_VELOCITIES = 22
# First candidates of the line search, as fractions of the Newton step: most often 1 is right.
FIRST_FRACTIONS = (
    *(0.0625, 0.125, 0.25, 0.375, 0.5, 0.625, 0.75, 0.875),
    *(1.0, 1.25, 1.5, 2.0, 3.0, 4.0, 8.0, 16.0),
)
SECOND_FRACTIONS = 16  # second candidates, between the two that enclose the minimum


class Problem(NamedTuple):
    """Minimised function of V velocities and E rows, the last 3 C of them from C contacts.

    Attributes:
      M: `[V, V]` inertia; f: `[V]` force of all but the constraints.
      A: `[E, V]`, b: `[E]`: rows and their reference accelerations, times the root of stiffness.
      mu: `[C]` slope of each contact's cone, 0 at its axis.
      equalities: number of equality rows, which come first; limits follow, then contacts.
    """

    M: jax.Array
    f: jax.Array
    A: jax.Array
    b: jax.Array
    mu: jax.Array
    equalities: int


class Iterate(NamedTuple):
    """An acceleration x `[V]`, its products M x and A x - b, and the cost's gradient `[V]`."""

    x: jax.Array
    Mx: jax.Array
    r: jax.Array
    gradient: jax.Array


def step(
    m: mjx.Model,
    d: mjx.Data,
    max_iterations: int | None = None,
    applied: jax.Array | None = None,
) -> tuple[mjx.Data, jax.Array]:
    """Does `mjx.step`: kinematics, contacts, forces and the implicit integrator.

    For models that pass `check`. The state's own `qfrc_applied` and `xfrc_applied` are ignored.

    Args:
      max_iterations: of Newton's method; `MAX_ITERATIONS` by default.
      applied: `[V]`, generalised forces from outside, or None.

    Returns:
      the state after; J `[]`, the energy that the error left in the solution may hold.
    """
    d = mjx.fwd_position(m, d)
    d = mjx.fwd_velocity(m, d)
    d = mjx.fwd_actuation(m, d)
    smooth = d.qfrc_passive - d.qfrc_bias + d.qfrc_actuator  # f: all forces but the constraints'
    d = d.replace(qfrc_smooth=smooth if applied is None else smooth + applied)
    x, force, error = solve(problem(m, d), d.qacc_warmstart, m.opt.timestep, max_iterations)
    # As `mjx.implicit`: servos and dampers at the velocity after the step. `mjx.euler` then only
    # integrates, since the model lets it do nothing about damping (flag eulerdamp).
    by_velocity = mjx.deriv_smooth_vel(m, d)
    assert by_velocity is not None, "a model without actuators and dampers"
    damped = d._impl.M - m.opt.timestep * by_velocity  # M - h df/dv
    d = d.replace(qacc=linear.solve_positive(damped, d.qfrc_smooth + force))
    # x, not the damped acceleration, is where the next step's Newton iteration begins.
    d = mjx.euler(m, d).replace(qacc=x, qacc_warmstart=x, qfrc_constraint=force)
    return d, error


def problem(m: mjx.Model, d: mjx.Data) -> Problem:
    """Returns the problem of a state with computed positions, velocities and actuators."""
    rows = d._impl
    root = jnp.sqrt(rows.efc_D)  # stiffness' root: the metric becomes Euclidean
    return Problem(
        M=rows.M,
        f=d.qfrc_smooth,
        A=root[:, None] * rows.efc_J,
        b=root * rows.efc_aref,
        # The scaled tangents are sqrt(impratio) stiffer: the cone of friction mu is narrower in
        # these units.
        mu=rows.contact.friction[:, 0] / jnp.sqrt(m.opt.impratio),
        equalities=int(rows.ne),
    )


def check(m: mjx.Model, d: mjx.Data) -> None:
    """Raises ValueError for a model with constraints that this solver does not support."""
    if d._impl.M.ndim != 2:
        raise ValueError(
            f"model: expected dense matrices (option jacobian), got sparse ones, {m.nv} velocities"
        )
    if d._impl.nf or np.any(d._impl.contact.dim != 3):
        raise ValueError(
            "model: expected contacts of condim 3 and no friction loss, got condim "
            f"{sorted(set(d._impl.contact.dim.tolist()))} and {d._impl.nf} rows of friction loss"
        )
    settings = m.opt.cone, m.opt.integrator, m.opt.disableflags & mjx.DisableBit.EULERDAMP
    if settings != (
        mjx.ConeType.ELLIPTIC,
        mjx.IntegratorType.IMPLICITFAST,
        mjx.DisableBit.EULERDAMP,
    ):
        raise ValueError(
            "model: expected an elliptic cone, the integrator implicitfast and eulerdamp disabled, "
            f"got {m.opt.cone.name}, {m.opt.integrator.name} and flags {m.opt.disableflags!r}"
        )


def solve(
    problem: Problem, x: jax.Array, timestep: float | jax.Array, max_iterations: int | None = None
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Minimises by Newton's method from `x` `[V]`, single-sample.

    A non-finite lane stays so and ends at once.

    Returns:
      acceleration `[V]`; the constraints' force on the velocities `[V]`; energy bound of the
      remaining error `[]` in J: above `MAX_ERROR_ENERGY` times `size_factor` it did not converge.
    """
    M, f, A, b, _, _ = problem
    # An error e in x has e M e <= gradient M^-1 gradient, since the Hessian is at least M. The
    # diagonal of M is enough: the motors' armature dominates.
    limit = 2.0 * MAX_ERROR_ENERGY * size_factor(len(x)) / timestep**2
    max_iterations = MAX_ITERATIONS if max_iterations is None else max_iterations
    weights = 1.0 / jnp.diagonal(M)

    def at(x: jax.Array, Mx: jax.Array, r: jax.Array) -> Iterate:
        return Iterate(x, Mx, r, Mx - f + pull(problem, r) @ A)  # M x - f + A' (r - nearest point)

    def is_coarse(now: Iterate) -> jax.Array:
        return jnp.sum(now.gradient**2 * weights) > limit  # g' diag(M)^-1 g

    def improve(now: Iterate) -> Iterate:
        # Newton direction: (M + B'B) p = -gradient. The cost's slope at x + s p is
        # (M x - f) p + s p M p + pull(r + s A p) A p.
        B = half_hessian(problem, now.r)
        p = -linear.solve_positive(M + B.T @ B, now.gradient)
        Mp, Ap = M @ p, A @ p  # once: candidates then cost O(E), not O(V^2)
        slope_0, bend = p @ (now.Mx - f), p @ Mp  # smooth part of the slope, linear in the fraction

        def slope(fraction: jax.Array) -> jax.Array:
            return slope_0 + fraction * bend + pull(problem, now.r + fraction * Ap) @ Ap

        # A full Newton step overshoots where a contact changes its zone.
        fraction = line_search(slope, now.gradient @ p)
        # No new products
        return at(now.x + fraction * p, now.Mx + fraction * Mp, now.r + fraction * Ap)

    start = at(x, M @ x, A @ x - b)
    end = iteration.improve_while(is_coarse, improve, start, max_iterations)
    error = 0.5 * timestep**2 * jnp.sum(end.gradient**2 * weights)  # (h e)' M (h e) / 2, J
    return end.x, -pull(problem, end.r) @ A, error  # A' lambda: forces push back into the set


def size_factor(velocities: int) -> float:
    """Returns the factor of limits on the error's energy for a scene with so many velocities."""
    return max(1.0, velocities / TUNED_VELOCITIES)


def line_search(slope: Callable[[jax.Array], jax.Array], first: jax.Array) -> jax.Array:
    """Finds the minimum of a convex function of one variable on the positive axis.

    Two rounds of parallel candidates enclose the slope's zero, then the secant through both ends.

    Args:
      slope: increasing function of a fraction `[]`.
      first: `[]`, the negative slope at 0.

    Returns:
      `[]`, no larger than the last of `FIRST_FRACTIONS`.
    """
    low, high = jnp.zeros_like(first), jnp.full_like(first, FIRST_FRACTIONS[-1])
    slopes = first, jnp.full_like(first, jnp.inf)
    between = np.linspace(0.0, 1.0, SECOND_FRACTIONS + 2, dtype=np.float32)[1:-1]
    for second in (False, True):
        fractions = low + (high - low) * between if second else jnp.asarray(FIRST_FRACTIONS)
        values = jax.vmap(slope)(fractions)
        falls = values < 0  # candidates before the minimum: convex, so the slope changes sign once
        low = jnp.max(fractions, where=falls, initial=low)
        high = jnp.min(fractions, where=~falls, initial=high)
        slopes = (
            jnp.max(values, where=falls, initial=slopes[0]),
            jnp.min(values, where=~falls, initial=slopes[1]),
        )
    rise = slopes[1] - slopes[0]
    is_enclosed = jnp.isfinite(rise) & (rise > 0)
    # Secant: exact for contacts that keep their zone, up to the cones' curvature.
    fraction = jnp.where(is_enclosed, -slopes[0] / jnp.where(is_enclosed, rise, 1.0), 1.0)
    return low + (high - low) * jnp.clip(fraction, 0.0, 1.0)


def pull(problem: Problem, r: jax.Array) -> jax.Array:
    """Returns the vector `[E]` to `r` from the nearest point that satisfies the constraints."""
    others, contacts = _split(problem, r)
    # Three zones of a contact. Inside the cone depth is 0: no force. In the polar cone, where
    # mu n + t <= 0, the apex is nearest: it sticks, and all of r counts. In between the nearest
    # point is on the cone's surface: it slips, and the force is along the surface's normal.
    slip = jnp.concatenate([-jnp.ones_like(contacts.mu), contacts.mu * contacts.along], 1)
    rows = jnp.where(contacts.sticks, contacts.r, contacts.depth * slip)
    return jnp.concatenate([jnp.where(_holds(problem, others), others, 0.0), rows.reshape(-1)])


def half_hessian(problem: Problem, r: jax.Array) -> jax.Array:
    """Returns B `[E, V]`: B' B is the second derivative of the constraints' cost at `r` `[E]`.

    A sticking contact adds its three rows; a slipping one the cone's normal, and the cone's
    curvature across the slip's direction.
    """
    others, contacts = _split(problem, r)
    A_others, A_contacts = problem.A[: len(others)], problem.A[len(others) :]
    # [C, V] each
    normal, first, second = jnp.moveaxis(A_contacts.reshape(-1, 3, A_contacts.shape[1]), 1, 0)
    x, y = contacts.along[:, :1], contacts.along[:, 1:]
    # Rows turned to the slip's direction
    along, across = x * first + y * second, x * second - y * first
    mu, sticks = contacts.mu, contacts.sticks
    slips = ~sticks & (contacts.depth > 0)  # the rest is inside the cone: no cost
    # Unit normal of the cone's surface at the nearest point, (1, -mu) / sqrt(1 + mu^2).
    outward = jnp.where(slips, (normal - mu * along) * jax.lax.rsqrt(1.0 + mu**2), 0.0)
    rows = (
        jnp.where(_holds(problem, others)[:, None], A_others, 0.0),
        jnp.where(sticks, normal, outward),
        jnp.where(sticks, along, 0.0),
        jnp.where(sticks, across, jnp.sqrt(contacts.bend) * across),
    )
    return jnp.concatenate(rows)


class _Contacts(NamedTuple):
    """Positions of contacts relative to their cones; all `[C, 1]` unless stated.

    Attributes:
      r: `[C, 3]`, along the normal and both tangents.
      along: `[C, 2]`, unit vector of the tangential part.
      mu: slope of the cone.
      sticks: True if the cone's apex is the nearest point.
      depth: distance from the cone along its axis, over 1 + mu^2.
      bend: curvature of the squared distance across the slip's direction.
    """

    r: jax.Array
    along: jax.Array
    mu: jax.Array
    sticks: jax.Array
    depth: jax.Array
    bend: jax.Array


def _split(problem: Problem, r: jax.Array) -> tuple[jax.Array, _Contacts]:
    count = problem.mu.shape[0]
    others, r = r[: r.shape[0] - 3 * count], r[r.shape[0] - 3 * count :].reshape(count, 3)
    mu, normal, tangents = problem.mu[:, None], r[:, :1], r[:, 1:]
    square = jnp.sum(tangents**2, -1, keepdims=True)
    is_sideways = square > 0
    size = jnp.sqrt(jnp.where(is_sideways, square, 1.0))  # both sides finite: NaN-free gradients
    along = jnp.where(is_sideways, tangents / size, np.array([1.0, 0.0], np.float32))
    sideways = jnp.where(is_sideways, size, 0.0)
    # Distance mu t - n along the axis; the projection on the cone's normal divides by 1 + mu^2.
    depth = jnp.maximum(mu * sideways - normal, 0.0) / (1.0 + mu**2)
    # Curvature mu / t of the cone's circle, times depth
    bend = jnp.where(is_sideways, mu * depth / size, 0.0)
    return others, _Contacts(r, along, mu, mu * normal + sideways <= 0, depth, bend)


def _holds(problem: Problem, others: jax.Array) -> jax.Array:
    """Returns True for the active rows before the contacts': equalities and exceeded limits."""
    # An equality always pulls; a limit only once it is exceeded (r < 0).
    return (others < 0) | jnp.asarray(np.arange(others.shape[0]) < problem.equalities)
