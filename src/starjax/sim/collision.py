"""Detection of overlaps of arms, shafts and jaws that the physics does not model.

The physics models contacts of geoms with contact bits in the MJCF. All others are detected here, as
a diagnostic flag that does not affect success. Approximations: obstacles are the task's capsules, a
shaft and the part between a shaft and its jaws are rows of points, and the jaws are the end of
their axis. Up to 3 mm of a pad's corner below the floor therefore stay undetected with a tool that
leans by 30 degrees.
"""

import functools
from collections.abc import Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from starjax import rcm
from starjax.core.types import Pose
from starjax.sim.scene import BoundArm
from starjax.sim.task import Capsules

# Overlap that is called a collision (m): more than the soft contacts' own give.
DEPTH = 0.0005
SHAFT_POINTS = 7  # looked at along the end of a shaft
PALM_POINTS = 3  # looked at between a shaft and its jaws

Overlaps = Iterable[tuple[str, jax.Array]]  # name of a pair, bool `[]` or `[points, obstacles]`


def detect(
    arms: Sequence[BoundArm],
    pose: Pose,
    origins: Sequence[jax.Array],
    p_world_trocar: jax.Array,
    obstacles: Capsules,
    floor: float,
    carried: Pose | None = None,
) -> jax.Array:
    """Returns True if any pair overlaps by more than `DEPTH`.

    Args:
      arms: A of them.
      pose: pose_world_tip `[A]`.
      origins: `[J, 3]` m of each arm, its joints' origins.
      p_world_trocar: `[A, 3]` m, the upper ends of the shafts that are inside.
      obstacles: of the task.
      floor: m, the lowest height that jaws may reach; the table is at 0.
      carried: `[A]`, of the frame at the end of each arm: the shaft before a wrist, else the tip.
        Needed in a scene with a wrist.
    """
    overlaps = _all(arms, pose, origins, p_world_trocar, obstacles, floor, carried)
    hits = (jnp.any(overlap) if overlap.ndim else overlap for _, overlap in overlaps)
    return functools.reduce(jnp.logical_or, hits, jnp.zeros((), bool))


def pairs(*args: Any) -> dict[str, jax.Array]:
    """Returns bool by the name of a pair: True if the pair overlaps; arguments as of `detect`."""
    overlaps = {}
    for name, overlap in _all(*args):
        if overlap.ndim:  # points of a shaft by obstacles
            overlaps |= {f"{name} {k}": hit for k, hit in enumerate(jnp.any(overlap, axis=0))}
        else:
            overlaps[name] = overlap
    return overlaps


def _all(
    arms: Sequence[BoundArm],
    pose: Pose,
    origins: Sequence[jax.Array],
    p_world_trocar: jax.Array,
    obstacles: Capsules,
    floor: float,
    carried: Pose | None = None,
) -> Overlaps:
    """Yields the overlaps of all pairs; arguments as of `detect`."""
    shaft = pose if carried is None else carried
    yield from _with_scene(arms, pose, shaft, origins, obstacles, floor)
    yield from _of_shafts(arms, shaft, p_world_trocar)
    yield from _of_links(arms, origins)
    yield from _of_palms(arms, pose, shaft, p_world_trocar, obstacles)


def _with_scene(
    arms: Sequence[BoundArm],
    pose: Pose,
    carried: Pose,
    origins: Sequence[jax.Array],
    obstacles: Capsules,
    floor: float,
) -> Overlaps:
    """Yields overlaps of each arm with the table, the floor and the obstacles."""
    for a, bound in enumerate(arms):
        tool, axis = bound.tool, carried.R[a, :, 2]
        # m from the tip up
        along = tool.shaft_end + jnp.linspace(0.0, tool.shaft_reach, SHAFT_POINTS)
        shaft = carried.p[a] - along[:, None] * axis
        watched = origins[a][bound.arm.watched :, 2]
        end = pose.p[a, 2] + tool.pad_end * pose.R[a, :, 2][2]  # height of the pads' ends
        yield f"arm {a}: links, table", jnp.min(watched, initial=jnp.inf) < bound.arm.link_radius
        yield f"arm {a}: jaws, floor", end < floor - DEPTH
        yield f"arm {a}: shaft, table", jnp.min(shaft[:, 2]) < tool.shaft_radius - DEPTH
        # Contact of two capsules, less the tolerance
        gap = tool.shaft_radius + obstacles.radius - DEPTH
        apart = distance_sq(shaft[:, None], obstacles.start, obstacles.end)
        yield f"arm {a}: shaft, obstacle", apart < gap**2


def distance_sq(points: jax.Array, start: jax.Array, end: jax.Array) -> jax.Array:
    """Returns squared distances (m^2) of `points` `[..., 3]` from segments; all broadcast."""
    way, off = end - start, points - start
    square = jnp.maximum(jnp.sum(way * way, axis=-1), 1e-12)
    # Nearest point, on the segment
    fraction = jnp.clip(jnp.sum(off * way, axis=-1) / square, 0.0, 1.0)
    return jnp.sum((off - fraction[..., None] * way) ** 2, axis=-1)


def _of_palms(
    arms: Sequence[BoundArm],
    pose: Pose,
    carried: Pose,
    p_world_trocar: jax.Array,
    obstacles: Capsules,
) -> Overlaps:
    """Yields overlaps of the parts between shafts and jaws with the scene and other arms."""
    palms = {
        a: _palm(bound.tool.wrist, _of(pose, a), _of(carried, a))
        for a, bound in enumerate(arms)
        if bound.tool.wrist is not None
    }
    for a, points in palms.items():
        radius = arms[a].tool.palm_radius
        yield f"arm {a}: palm, table", jnp.min(points[:, 2]) < radius - DEPTH
        apart = distance_sq(points[:, None], obstacles.start, obstacles.end)
        yield f"arm {a}: palm, obstacle", apart < (radius + obstacles.radius - DEPTH) ** 2
        for b, bound in enumerate(arms):
            if a == b:
                continue
            end = carried.p[b] - bound.tool.shaft_end * carried.R[b, :, 2]
            gap = radius + bound.tool.shaft_radius - DEPTH
            near = jnp.min(distance_sq(points, p_world_trocar[b], end)) < gap**2
            yield f"palm of arm {a} and shaft of arm {b}", near
            if a < b and b in palms:
                gap = radius + bound.tool.palm_radius - DEPTH
                near = jnp.min(distance_sq(points, palms[b][0], palms[b][-1])) < gap**2
                yield f"palms of arms {a} and {b}", near


def _palm(wrist: rcm.Wrist, tip: Pose, shaft: Pose) -> jax.Array:
    """Returns points `[K, 3]` m from the pitch axis to the yaw axis."""
    end = tip.p - wrist.jaws * tip.R[:, 2]  # the yaw axis
    return shaft.p + jnp.linspace(0.0, 1.0, PALM_POINTS)[:, None] * (end - shaft.p)


def _of(pose: Pose, a: int) -> Pose:
    return Pose(pose.R[a], pose.p[a])


def _of_shafts(arms: Sequence[BoundArm], carried: Pose, p_world_trocar: jax.Array) -> Overlaps:
    """Yields overlaps of two shafts between the trocar and their lower ends."""
    fraction = jnp.linspace(0.0, 1.0, 4 * SHAFT_POINTS)[:, None]
    for a, first in enumerate(arms):
        ends = carried.p[a] - first.tool.shaft_end * carried.R[a, :, 2]
        # Points of one shaft against the other's segment: cheaper than two segments, and as exact
        # as the points are dense.
        points = p_world_trocar[a] + fraction * (ends - p_world_trocar[a])
        for b, second in list(enumerate(arms))[a + 1 :]:
            end = carried.p[b] - second.tool.shaft_end * carried.R[b, :, 2]
            gap = first.tool.shaft_radius + second.tool.shaft_radius - DEPTH
            near = jnp.min(distance_sq(points, p_world_trocar[b], end)) < gap**2
            yield f"shafts of arms {a} and {b}", near


def _of_links(arms: Sequence[BoundArm], origins: Sequence[jax.Array]) -> Overlaps:
    """Yields True for joints of two arms closer than the sum of their links' radii."""
    for a, first in enumerate(arms):
        for b, second in list(enumerate(arms))[a + 1 :]:
            apart = jnp.sum((origins[a][:, None] - origins[b]) ** 2, axis=-1)  # [J_a, J_b] m^2
            gap = first.arm.link_radius + second.arm.link_radius
            yield f"links of arms {a} and {b}", jnp.min(apart) < gap**2
