"""Notices where arm, shaft and jaws touch things they have no modelled contact with.

The physics models pads against walls and pegs, walls against pegs, feet against the board. The rest
is watched here. It is a flag beside the outcome of a trial, which it does not decide, and a rough
one: walls count as the sides of a full triangle, 3.5 mm longer at either end than they are, and of
the jaws only the end of their axis is looked at, so that a tool that leans by 30 degrees gets a
pad's corner up to 3 mm into the board unnoticed.
"""

import jax
import jax.numpy as jnp

from starjax.sim.tasks.peg_transfer import task
from starjax.types import Pose

# Overlap that is called a collision (m): more than the soft contacts' own give.
DEPTH = 0.0005
SHAFT_RADIUS = 0.0025
# The shaft's lower end lies this far before the tcp (m), the pads' ends this far past it.
SHAFT_END = 0.012
PAD_END = 0.0025
# Length of shaft above its end that can reach a peg or the block (m), and points taken on it.
SHAFT_REACH = 0.036
SHAFT_POINTS = 7
# Radius of the arm's links (m).
LINK_RADIUS = 0.05
PEG_RADIUS = 0.001125


def detect(pose: Pose, origins: jax.Array, block: Pose, pegs: jax.Array) -> jax.Array:
    """Whether something overlaps by more than `DEPTH`.

    Args:
      pose: pose_world_tip. origins: `[6, 3]` m, the joints' origins.
      block: pose_world_block. pegs: `[P, 2]` m.
    """
    axis = pose.R[:, 2]
    along = SHAFT_END + jnp.linspace(0.0, SHAFT_REACH, SHAFT_POINTS)
    shaft = pose.p - along[:, None] * axis
    arm_on_board = jnp.min(origins[2:, 2]) < LINK_RADIUS
    jaws_in_board = pose.p[2] + PAD_END * axis[2] < -DEPTH
    shaft_in_board = jnp.min(shaft[:, 2]) < SHAFT_RADIUS - DEPTH
    peg_end = task.PEG_HEIGHT - PEG_RADIUS  # of the capsule's axis
    above = jnp.maximum(shaft[:, None, 2] - peg_end, 0.0)
    aside = jnp.sum((shaft[:, None, :2] - pegs) ** 2, axis=-1)
    shaft_in_peg = jnp.min(aside + above**2) < (SHAFT_RADIUS + PEG_RADIUS - DEPTH) ** 2
    gap = SHAFT_RADIUS + task.WALL_RADIUS - DEPTH
    shaft_in_block = jnp.min(_distance_sq_to_walls(shaft, block)) < gap**2
    return arm_on_board | jaws_in_board | shaft_in_board | shaft_in_peg | shaft_in_block


def _distance_sq_to_walls(points: jax.Array, block: Pose) -> jax.Array:
    """`[N, 3]` squared distances (m^2) of `points` `[N, 3]` from the walls' centre lines."""
    normals = task.wall_normals(block)
    tangents = jnp.cross(block.R[:, 2], normals)
    half = jnp.sqrt(3.0) * task.RIM_RADIUS
    off = points[:, None] - (block.p + task.RIM_RADIUS * normals)
    along = jnp.clip(jnp.sum(off * tangents, axis=-1), -half, half)
    return jnp.sum((off - along[..., None] * tangents) ** 2, axis=-1)
