"""Peg transfer: what varies from episode to episode, and when it counts as done.

Lengths in m. Block frame: origin at the rim's centre, z up when it stands; wall i's outward normal
is at 120 i degrees from x.
"""

import flax.struct
import jax
import jax.numpy as jnp

from starjax.types import Pose

# The block, as in peg_transfer.xml (a test holds these to the compiled model).
RIM_RADIUS = 0.007  # from the axis to a wall's centre line
WALL_RADIUS = 0.0015  # of the capsules
RIM_HEIGHT = 0.009  # above the board when it stands
WALLS = 3
PEG_HEIGHT = 0.012

# Where an episode begins.
BLOCK_OFFSET = 0.001  # block's centre from its peg, each axis, at most
BLOCK_YAW = 0.5236  # rad, either way: half of all that can be told apart, the rim being triangular
TIP_HOME = (0.0, 0.0, 0.05)
TIP_SPREAD = 0.01  # each axis, at most

# Strict success: threaded, standing, upright, released, at rest for SETTLE_STEPS control steps.
HEIGHT_TOLERANCE = 0.0015
UPRIGHT_COS = 0.985
REST_SPEED = 0.01  # m/s
REST_SPIN = 0.5  # rad/s
SETTLE_STEPS = 5

# SurRoL's looser test: block within these of the peg's axis and of its resting height.
LOOSE_XY = 0.005
LOOSE_Z = 0.004


@flax.struct.dataclass
class Layout:
    """What is drawn at reset.

    Attributes:
      source, target: `[]` int32 peg indices, 0-5 and 6-11.
      block: pose_world_block at the start.
      tip: `[3]` m, where the tool's tip starts.
    """

    source: jax.Array
    target: jax.Array
    block: Pose
    tip: jax.Array


def sample_layout(key: jax.Array, pegs: jax.Array) -> Layout:
    """Draws source and target peg, the block's offset and yaw, and the tip's start.

    Args:
      pegs: `[P, 2]` m; the first half are sources, the second targets.
    """
    key_source, key_target, key_offset, key_yaw, key_tip = jax.random.split(key, 5)
    half = pegs.shape[0] // 2
    source = jax.random.randint(key_source, (), 0, half)
    target = jax.random.randint(key_target, (), half, 2 * half)
    xy = pegs[source] + jax.random.uniform(
        key_offset, (2,), minval=-BLOCK_OFFSET, maxval=BLOCK_OFFSET
    )
    yaw = jax.random.uniform(key_yaw, minval=-BLOCK_YAW, maxval=BLOCK_YAW)
    tip = jnp.array(TIP_HOME) + jax.random.uniform(
        key_tip, (3,), minval=-TIP_SPREAD, maxval=TIP_SPREAD
    )
    c, s, o, one = jnp.cos(yaw), jnp.sin(yaw), jnp.zeros(()), jnp.ones(())
    R = jnp.stack([jnp.stack([c, -s, o]), jnp.stack([s, c, o]), jnp.stack([o, o, one])])
    block = Pose(R, jnp.append(xy, RIM_HEIGHT))
    return Layout(source=source, target=target, block=block, tip=tip)


def wall_normals(block: Pose) -> jax.Array:
    """`[3, 3]` outward normals of the walls in the world, one a row."""
    angle = jnp.arange(WALLS) * (2 * jnp.pi / WALLS)
    in_block = jnp.stack([jnp.cos(angle), jnp.sin(angle), jnp.zeros(WALLS)], axis=-1)
    return in_block @ block.R.T


def is_threaded(block: Pose, peg: jax.Array) -> jax.Array:
    """Whether the block stands on the board with the peg `[2]` m inside its opening."""
    reach = jnp.max(wall_normals(block)[:, :2] @ (peg - block.p[:2]))
    stands = jnp.abs(block.p[2] - RIM_HEIGHT) < HEIGHT_TOLERANCE
    return (reach < RIM_RADIUS - WALL_RADIUS) & stands & (block.R[2, 2] > UPRIGHT_COS)


def is_near(block: Pose, peg: jax.Array) -> jax.Array:
    """SurRoL's success test: close to the peg, whether threaded, released, at rest or not."""
    off = block.p[:2] - peg
    return (jnp.sum(off * off) < LOOSE_XY**2) & (jnp.abs(block.p[2] - RIM_HEIGHT) < LOOSE_Z)


def is_at_rest(velocity: jax.Array) -> jax.Array:
    """Whether the block's free-joint velocity `[6]` (m/s, rad/s) is that of a block at rest."""
    slow = jnp.sum(velocity[:3] ** 2) < REST_SPEED**2
    return slow & (jnp.sum(velocity[3:] ** 2) < REST_SPIN**2)
