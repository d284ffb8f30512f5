"""The hole that a needle makes: pierced at a force, cut along the point's path, left at the exit.

The pad's surface is the plane z = 0. A point that touches it is caught: the dimple pushes back like
a spring until the needle pierces it. From then on the wire must pass a few points of the path that
its point has cut. They yield across the wire like a spring and a damper, and rub along it.
"""

import flax.struct
import jax
import jax.numpy as jnp

from starjax.addons.suture.tissue import needle as needles
from starjax.addons.suture.tissue import rows as bodies
from starjax.addons.suture.tissue.needle import Needle
from starjax.core.types import Pose

# Force of piercing (N): soft skin asks a needle holder for 0.70 N (mpatkin.org, tests of seven
# laparoscopic needle holders). All other constants are assumed.
PUNCTURE = 0.7
DIMPLE, DIMPLE_DAMPING = 1000.0, 0.5  # N/m, N s/m, of the surface before it is pierced
ACROSS, ACROSS_DAMPING = 400.0, 1.0  # N/m, N s/m, of each point of the hole across the wire
CUT = 0.3  # N, of the point on its way
FRICTION = 30.0  # N per m of wire inside
DRAG = 40.0  # N s/m of friction and of cutting, below their bounds
POINTS = 4  # points of the path that are kept; the last one is the exit
SPACING = 0.0035  # m between them
NEAR_ENTRY = 0.002  # m: a point that leaves there has come back


@flax.struct.dataclass
class NeedleHole:
    """State of one hole; positions in m in the world.

    Attributes:
      points: `[POINTS, 3]` of the path, and their `count`, int32.
      touches, is_inside, has_exited, is_through: bool: the point dimples the surface; the wire is
        in the hole; its point has left it; its swage has too.
      entry, exit: `[3]`, where the surface was first touched, and where the point left it.
      force: N, the present largest one across the wire at a point. max_force: the largest so far.
    """

    points: jax.Array
    count: jax.Array
    touches: jax.Array
    is_inside: jax.Array
    has_exited: jax.Array
    is_through: jax.Array
    entry: jax.Array
    exit: jax.Array
    force: jax.Array
    max_force: jax.Array


def none() -> NeedleHole:
    """Returns the state before a hole."""
    no, zero, nowhere = jnp.zeros((), bool), jnp.zeros(()), jnp.zeros(3)
    count = jnp.zeros((), jnp.int32)
    points = jnp.zeros((POINTS, 3))
    return NeedleHole(points, count, no, no, no, no, nowhere, nowhere, zero, zero)


def advance(needle: Needle, pose: Pose, hole: NeedleHole) -> NeedleHole:
    """Returns the state with the events of this moment: touched, pierced, cut, left."""
    tip = needles.point_at(needle, pose, jnp.asarray(needle.end))
    is_below = tip[2] < 0.0
    is_outside = ~(hole.is_inside | hole.is_through)
    # Touched, and pierced once the dimple's spring exceeds the force.
    begins = is_outside & is_below & ~hole.touches
    entry = jnp.where(begins, tip.at[2].set(0.0), hole.entry)
    pierces = is_outside & is_below & (DIMPLE * jnp.linalg.norm(tip - entry) > PUNCTURE)
    points = jnp.where(pierces, hole.points.at[0].set(entry), hole.points)
    count = jnp.where(pierces, 1, hole.count)
    # Cut: a point of the path in every SPACING.
    last = points[jnp.maximum(count - 1, 0)]
    is_cutting = hole.is_inside & ~hole.has_exited
    adds = is_cutting & (count < POINTS - 1) & (jnp.linalg.norm(tip - last) > SPACING)
    points = jnp.where(adds, points.at[count % POINTS].set(tip), points)
    count = count + adds
    # Left at the far side, or back at the entry.
    is_far = jnp.linalg.norm(tip - entry) > NEAR_ENTRY
    exits = is_cutting & ~is_below & is_far
    out = tip.at[2].set(0.0)
    points = jnp.where(exits, points.at[count % POINTS].set(out), points)
    count = count + exits
    angles = _angles(needle, pose, points)
    is_back = hole.is_inside & (angles[0] > needle.end)
    is_through = hole.is_through | (hole.has_exited & (angles[count - 1] < -needle.end))
    stays = (hole.is_inside | pierces) & ~is_back & ~is_through
    return hole.replace(
        points=points,
        count=jnp.where(is_back, 0, count),
        touches=is_outside & is_below & ~pierces,
        is_inside=stays,
        has_exited=(hole.has_exited | exits) & ~is_back,
        is_through=is_through,
        entry=entry,
        exit=jnp.where(exits, out, hole.exit),
    )


def inside(needle: Needle, pose: Pose, hole: NeedleHole) -> jax.Array:
    """Returns the angle (rad) of the wire between the entry and its point or the exit."""
    angles = _angles(needle, pose, hole.points)
    end = jnp.where(hole.has_exited, angles[jnp.maximum(hole.count - 1, 0)], needle.end)
    return jnp.where(hole.is_inside, jnp.maximum(end - angles[0], 0.0), 0.0)


def emerged(needle: Needle, pose: Pose, hole: NeedleHole) -> jax.Array:
    """Returns the length (m) of the wire that has left at the exit."""
    angle, _, _ = needles.coordinates(needle, pose, hole.exit)
    out = needle.radius * jnp.clip(needle.end - angle, 0.0, needle.sweep)
    return jnp.where(hole.has_exited, out, 0.0)


def rows(needle: Needle, pose: Pose, hole: NeedleHole) -> bodies.ForceRows:
    """Returns the rows of the hole: 3 per point, 1 of the cut, 3 of the dimple."""
    length = needle.radius * inside(needle, pose, hole)
    rub = FRICTION * length / jnp.maximum(hole.count, 1)
    points, is_on_wire = jax.vmap(lambda p: _of_point(needle, pose, p, rub))(hole.points)
    is_kept = hole.is_inside & (jnp.arange(POINTS) < hole.count) & is_on_wire
    tip = needles.point_at(needle, pose, jnp.asarray(needle.end))
    ahead = needles.tangent_at(pose, jnp.asarray(needle.end))
    zero = jnp.zeros(1)
    cut = bodies.made(bodies.at_point(pose, tip, ahead[None]), zero, 0.0, DRAG, CUT)
    J = bodies.at_point(pose, tip, jnp.eye(3))
    dimple = bodies.made(J, tip - hole.entry, DIMPLE, DIMPLE_DAMPING)
    # The surface pushes up only, and the cut resists only the way ahead.
    dimple = dimple._replace(low=dimple.low.at[2].set(0.0))
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), points)
    is_present = [
        jnp.repeat(is_kept, 3),
        (hole.is_inside & ~hole.has_exited)[None],
        jnp.repeat(hole.touches, 3),
    ]
    found = bodies.joined([flat, cut._replace(high=zero), dimple])
    return bodies.present(found, jnp.concatenate(is_present))


def _of_point(
    needle: Needle, pose: Pose, p: jax.Array, rub: jax.Array
) -> tuple[bodies.ForceRows, jax.Array]:
    """Returns the 3 rows of a point: out, along the normal and along the wire; True on the wire."""
    angle, distance, height = needles.coordinates(needle, pose, p)
    cos, sin, zero = jnp.cos(angle), jnp.sin(angle), jnp.zeros(())
    own = jnp.stack([cos, sin, zero, zero, zero, 1.0 + zero, -sin, cos, zero]).reshape(3, 3)
    J = bodies.at_point(pose, p, own @ pose.R.T)
    stretch = jnp.stack([needle.radius - distance, -height, zero])
    across = jnp.array([1.0, 1.0, 0.0])
    damping = ACROSS_DAMPING * across + DRAG * (1.0 - across)
    bound = jnp.where(across > 0, jnp.inf, rub)
    return bodies.made(J, stretch, ACROSS * across, damping, bound), jnp.abs(angle) <= needle.end


ROWS = 3 * POINTS + 4


def with_forces(hole: NeedleHole, forces: jax.Array) -> NeedleHole:
    """Returns the state with the force across the wire; `forces` `[ROWS]` N are of `rows`."""
    across = forces[: 3 * POINTS].reshape(POINTS, 3)[:, :2]
    force = jnp.max(jnp.linalg.norm(across, axis=-1))
    return hole.replace(force=force, max_force=jnp.maximum(hole.max_force, force))


def _angles(needle: Needle, pose: Pose, points: jax.Array) -> jax.Array:
    return jax.vmap(lambda p: needles.coordinates(needle, pose, p)[0])(points)
