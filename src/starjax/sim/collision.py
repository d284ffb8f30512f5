"""Detection of overlaps of arms, shafts and jaws that the physics does not model.

The physics models contacts of geoms with contact bits in the MJCF. All others are detected here, as
a diagnostic flag that does not affect success. Approximations: obstacles are the task's capsules, a
shaft is a row of points, and the jaws are the end of their axis. Up to 3 mm of a pad's corner below
the floor therefore stay undetected with a tool that leans by 30 degrees.
"""

from collections.abc import Iterable, Sequence

import jax
import jax.numpy as jnp

from starjax.sim.scene import BoundArm
from starjax.sim.tasks.base import Capsules
from starjax.types import Pose

# Overlap that is called a collision (m): more than the soft contacts' own give.
DEPTH = 0.0005
SHAFT_POINTS = 7  # looked at along the end of a shaft

Overlaps = Iterable[tuple[str, jax.Array]]  # name of a pair, bool `[]` or `[points, obstacles]`


def detect(
    arms: Sequence[BoundArm],
    pose: Pose,
    origins: Sequence[jax.Array],
    p_world_trocar: jax.Array,
    obstacles: Capsules,
    floor: float,
) -> jax.Array:
    """Returns True if any pair overlaps by more than `DEPTH`.

    Args:
      arms: A of them.
      pose: pose_world_tip `[A]`.
      origins: `[J, 3]` m of each arm, its joints' origins.
      p_world_trocar: `[A, 3]` m, the upper ends of the shafts that are inside.
      obstacles: of the task.
      floor: m, the lowest height that jaws may reach; the table is at 0.
    """
    hit = _any(_with_scene(arms, pose, origins, obstacles, floor))
    return hit | _any(_of_shafts(arms, pose, p_world_trocar)) | _any(_of_links(arms, origins))


def pairs(
    arms: Sequence[BoundArm],
    pose: Pose,
    origins: Sequence[jax.Array],
    p_world_trocar: jax.Array,
    obstacles: Capsules,
    floor: float,
) -> dict[str, jax.Array]:
    """Returns bool by the name of a pair: True if the pair overlaps; arguments as of `detect`."""
    found = [
        *_with_scene(arms, pose, origins, obstacles, floor),
        *_of_shafts(arms, pose, p_world_trocar),
        *_of_links(arms, origins),
    ]
    overlaps = {}
    for name, overlap in found:
        if overlap.ndim:  # points of a shaft by obstacles
            overlaps |= {f"{name} {k}": hit for k, hit in enumerate(jnp.any(overlap, axis=0))}
        else:
            overlaps[name] = overlap
    return overlaps


def _any(overlaps: Overlaps) -> jax.Array:
    hit = jnp.zeros((), bool)
    for _, overlap in overlaps:
        hit |= jnp.any(overlap) if overlap.ndim else overlap
    return hit


def _with_scene(
    arms: Sequence[BoundArm],
    pose: Pose,
    origins: Sequence[jax.Array],
    obstacles: Capsules,
    floor: float,
) -> Overlaps:
    """Yields overlaps of each arm with the table, the floor and the obstacles."""
    for a, bound in enumerate(arms):
        tool, axis = bound.tool, pose.R[a, :, 2]
        along = tool.shaft_end + jnp.linspace(0.0, tool.shaft_reach, SHAFT_POINTS)
        shaft = pose.p[a] - along[:, None] * axis
        watched = origins[a][bound.arm.watched :, 2]
        yield f"arm {a}: links, table", jnp.min(watched, initial=jnp.inf) < bound.arm.link_radius
        yield f"arm {a}: jaws, floor", pose.p[a, 2] + tool.pad_end * axis[2] < floor - DEPTH
        yield f"arm {a}: shaft, table", jnp.min(shaft[:, 2]) < tool.shaft_radius - DEPTH
        gap = tool.shaft_radius + obstacles.radius - DEPTH
        apart = distance_sq(shaft[:, None], obstacles.start, obstacles.end)
        yield f"arm {a}: shaft, obstacle", apart < gap**2


def distance_sq(points: jax.Array, start: jax.Array, end: jax.Array) -> jax.Array:
    """Returns squared distances (m^2) of `points` `[..., 3]` from segments; all broadcast."""
    way, off = end - start, points - start
    square = jnp.maximum(jnp.sum(way * way, axis=-1), 1e-12)
    fraction = jnp.clip(jnp.sum(off * way, axis=-1) / square, 0.0, 1.0)
    return jnp.sum((off - fraction[..., None] * way) ** 2, axis=-1)


def _of_shafts(arms: Sequence[BoundArm], pose: Pose, p_world_trocar: jax.Array) -> Overlaps:
    """Yields overlaps of two shafts between the trocar and the tip."""
    fraction = jnp.linspace(0.0, 1.0, 4 * SHAFT_POINTS)[:, None]
    for a, first in enumerate(arms):
        ends = pose.p[a] - first.tool.shaft_end * pose.R[a, :, 2]
        points = p_world_trocar[a] + fraction * (ends - p_world_trocar[a])
        for b, second in list(enumerate(arms))[a + 1 :]:
            end = pose.p[b] - second.tool.shaft_end * pose.R[b, :, 2]
            gap = first.tool.shaft_radius + second.tool.shaft_radius - DEPTH
            near = jnp.min(distance_sq(points, p_world_trocar[b], end)) < gap**2
            yield f"shafts of arms {a} and {b}", near


def _of_links(arms: Sequence[BoundArm], origins: Sequence[jax.Array]) -> Overlaps:
    """Yields True for joints of two arms closer than the sum of their links' radii."""
    for a, first in enumerate(arms):
        for b, second in list(enumerate(arms))[a + 1 :]:
            apart = jnp.sum((origins[a][:, None] - origins[b]) ** 2, axis=-1)
            gap = first.arm.link_radius + second.arm.link_radius
            yield f"links of arms {a} and {b}", jnp.min(apart) < gap**2
