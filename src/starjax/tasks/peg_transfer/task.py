"""Peg transfer: a hollow block goes from a peg of one board to the marked peg of the other.

Lengths in m. Block frame: origin at the rim's centre, z up when it stands; wall i's outward normal
is at 120 i degrees from x.
"""

from typing import TYPE_CHECKING, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.core.types import Pose
from starjax.sim import bodies, endoscope_camera, workspaces
from starjax.sim.task import Capsules, Field, SimReadings, Slot, Task, TaskStatus
from starjax.tasks import rewards
from starjax.tasks.peg_transfer import text

if TYPE_CHECKING:  # a robot loads tasks without the simulator
    import mujoco

# The block, as in world.xml (a test holds these to the compiled model).
RIM_RADIUS = 0.007  # from the axis to a wall's centre line
WALL_RADIUS = 0.0015  # radius of the capsules
RIM_HEIGHT = 0.009  # above the board when it stands
WALLS = 3
PEG_HEIGHT = 0.012
PEG_RADIUS = 0.001125

# Where an episode begins.
BLOCK_OFFSET = 0.001  # block's centre from its peg, each axis, at most
BLOCK_YAW = 0.5236  # rad, either way: half of the distinguishable angles of a triangular rim
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

# Beyond these the simulation has diverged.
MAX_BLOCK_SPEED = 5.0  # m/s
MAX_BLOCK_DISTANCE = 1.0  # m from the board's centre

STAGES = ("approach", "grasped", "lifted", "at the target", "threaded", "done")
LIFTED = 0.004  # m above its resting height at which the block counts as lifted
NEAR = 0.03  # m, scale of distances in rewards and features
TARGET_RGB = (0.98, 0.62, 0.1)


@flax.struct.dataclass
class PegLayout:
    """Draws at reset.

    Attributes:
      source, target: `[]` int32 peg indices, 0-5 and 6-11.
      target_peg: `[2]` m, the target's axis.
      block: pose_world_block at the start.
      tip: `[3]` m, the tip's start.
    """

    source: jax.Array
    target: jax.Array
    target_peg: jax.Array
    block: Pose
    tip: jax.Array


@flax.struct.dataclass
class PegMeasurements:
    """Measurements of one moment.

    Attributes:
      block: pose_world_block.
      velocity: `[6]` of the block, m/s and rad/s.
      tip: `[3]` m, the tool's tip.
      touch: the jaws touch the block.
    """

    block: Pose
    velocity: jax.Array
    tip: jax.Array
    touch: jax.Array


class PegBound(NamedTuple):
    """Ids in the compiled model.

    Attributes:
      block, block_dof: first index of the block's coordinates in qpos and qvel.
      peg_geoms, seat_geoms: `[P]` geom ids.
      pegs: `[P, 2]` m, the pegs' axes; the first half are sources, the second targets.
    """

    block: int
    block_dof: int
    peg_geoms: np.ndarray
    seat_geoms: np.ndarray
    pegs: np.ndarray


def bind(m: "mujoco.MjModel") -> PegBound:
    """Resolves the ids of block, pegs and seats."""
    count = sum(m.geom(g).name.startswith("peg") for g in range(m.ngeom))
    peg_geoms = np.array([m.geom(f"peg{i}").id for i in range(count)])
    return PegBound(
        block=int(m.joint("block").qposadr[0]),
        block_dof=int(m.joint("block").dofadr[0]),
        peg_geoms=peg_geoms,
        seat_geoms=np.array([m.geom(f"seat{i}").id for i in range(count)]),
        pegs=np.array(m.geom_pos[peg_geoms, :2], np.float32),
    )


def sample(bound: PegBound, key: jax.Array) -> PegLayout:
    """Draws source and target peg, the block's offset and yaw, and the tip's start."""
    key_source, key_target, key_offset, key_yaw, key_tip = jax.random.split(key, 5)
    pegs = jnp.asarray(bound.pegs)
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
    block = Pose(rcm.rotation_z(yaw), jnp.append(xy, RIM_HEIGHT))
    return PegLayout(source=source, target=target, target_peg=pegs[target], block=block, tip=tip)


def place_objects(bound: PegBound, qpos: jax.Array, layout: PegLayout) -> jax.Array:
    """Places the block upright."""
    return qpos.at[bound.block : bound.block + 7].set(bodies.upright_coords(layout.block))


def measure(
    bound: PegBound, layout: PegLayout, readings: SimReadings, before: PegMeasurements | None
) -> PegMeasurements:
    """Measures the block's pose and velocity, the tip and its touch."""
    return PegMeasurements(
        block=bodies.free_pose(readings.qpos, bound.block),
        velocity=readings.qvel[bound.block_dof : bound.block_dof + 6],
        tip=readings.pose.p[0],
        touch=readings.touch[0],
    )


def status(bound: PegBound, layout: PegLayout, measurements: PegMeasurements) -> TaskStatus:
    """Tests strict success (threaded, released, at rest) and loose success (SurRoL's test)."""
    block, peg = measurements.block, layout.target_peg
    threaded = is_threaded(block, peg)
    # Released: jaws that still touch could carry it away.
    success_now = threaded & is_at_rest(measurements.velocity) & ~measurements.touch
    near, lifted = is_near(block, peg), block.p[2] > RIM_HEIGHT + LIFTED
    over = jnp.sum((block.p[:2] - peg) ** 2) < LOOSE_XY**2
    touch = measurements.touch
    stage = rewards.last_reached(
        touch, touch & lifted, over & (touch | near), threaded, success_now
    )
    terms = {
        "approach": rewards.nearness(jnp.linalg.norm(block.p - measurements.tip), NEAR),
        "grasped": rewards.nearness(jnp.linalg.norm(block.p[:2] - peg), NEAR),
    }
    reward = rewards.staged(STAGES, terms, stage, success_now)
    return TaskStatus(success_now, near, jnp.zeros((), bool), stage, reward)


def state(bound: PegBound, layout: PegLayout, measurements: PegMeasurements) -> jax.Array:
    """Returns `[12]`: the block's position and rotation, the target's position."""
    goal = jnp.append(layout.target_peg, RIM_HEIGHT)
    return jnp.concatenate([measurements.block.p, rcm.rot6d_encode(measurements.block.R), goal])


def relative(state: jax.Array, tips: jax.Array) -> jax.Array:
    """Returns `[..., 9]`: tip to block, in the world's and the block's frame, and tip to target.

    A grasp depends on them, and small networks compute such differences too coarsely from
    positions in the scale of the workspace.
    """
    tip = tips[..., 0, :]
    to_block, to_target = state[..., :3] - tip, state[..., 9:12] - tip
    block = rcm.rot6d_decode(state[..., 3:9])
    turned = jnp.einsum("...ji,...j->...i", block, to_block, precision="highest")
    return jnp.concatenate([to_block, turned, to_target], axis=-1) / NEAR


def colours(bound: PegBound, layout: PegLayout, rgb: jax.Array) -> jax.Array:
    """Marks the target peg and its seat."""
    seats, pegs = jnp.asarray(bound.seat_geoms), jnp.asarray(bound.peg_geoms)
    marked = jnp.stack([pegs[layout.target], seats[layout.target]])
    return rgb.at[marked].set(jnp.array(TARGET_RGB))


def obstacles(bound: PegBound, layout: PegLayout, measurements: PegMeasurements) -> Capsules:
    """Returns the pegs and the block's walls."""
    return around(bound, measurements.block)


def around(bound: PegBound, block: Pose) -> Capsules:
    """Returns the pegs, and the walls of a block at this pose.

    Walls are the sides of a full triangle, longer by 3.5 mm at either end than the real ones.
    """
    pegs = jnp.asarray(bound.pegs)
    foot = jnp.concatenate([pegs, jnp.zeros((len(pegs), 1))], axis=-1)
    normals = wall_normals(block)
    # Half a side: r tan 60 degrees
    half = jnp.sqrt(3.0) * RIM_RADIUS * jnp.cross(block.R[:, 2], normals)
    middle = block.p + RIM_RADIUS * normals
    return Capsules(
        start=jnp.concatenate([foot, middle - half]),
        end=jnp.concatenate([foot.at[:, 2].set(PEG_HEIGHT - PEG_RADIUS), middle + half]),
        radius=jnp.asarray(np.repeat([PEG_RADIUS, WALL_RADIUS], [len(pegs), WALLS]), jnp.float32),
    )


def is_sound(bound: PegBound, qpos: jax.Array, qvel: jax.Array) -> jax.Array:
    """Returns False once the block's simulation has diverged."""
    limits = MAX_BLOCK_SPEED, MAX_BLOCK_DISTANCE
    return bodies.is_sound(qpos, qvel, bound.block, bound.block_dof, *limits)


def wall_normals(block: Pose) -> jax.Array:
    """Returns the walls' outward normals in the world, rows of `[3, 3]`."""
    angle = jnp.arange(WALLS) * (2 * jnp.pi / WALLS)
    # Unit vectors at 0, 120 and 240 degrees
    in_block = jnp.stack([jnp.cos(angle), jnp.sin(angle), jnp.zeros(WALLS)], axis=-1)
    return in_block @ block.R.T


def is_threaded(block: Pose, peg: jax.Array) -> jax.Array:
    """Returns True if the block stands on the board with the peg `[2]` m inside its opening."""
    # The peg is inside the triangle if it lies behind all three walls: the largest distance
    # decides.
    reach = jnp.max(wall_normals(block)[:, :2] @ (peg - block.p[:2]))
    stands = jnp.abs(block.p[2] - RIM_HEIGHT) < HEIGHT_TOLERANCE
    return (reach < RIM_RADIUS - WALL_RADIUS) & stands & (block.R[2, 2] > UPRIGHT_COS)


def is_near(block: Pose, peg: jax.Array) -> jax.Array:
    """Tests SurRoL's success: close to the peg, without conditions on threading or release."""
    off = block.p[:2] - peg
    return (jnp.sum(off * off) < LOOSE_XY**2) & (jnp.abs(block.p[2] - RIM_HEIGHT) < LOOSE_Z)


def is_at_rest(velocity: jax.Array) -> jax.Array:
    """Returns True if the free-joint velocity `[6]` (m/s, rad/s) is that of a block at rest."""
    slow = jnp.sum(velocity[:3] ** 2) < REST_SPEED**2
    return slow & (jnp.sum(velocity[3:] ** 2) < REST_SPIN**2)


TASK = Task(
    name="peg_transfer",
    mjcf="tasks/peg_transfer/peg_transfer.xml",
    slots=(Slot(workspace="board", p_world_ref=(0.0, 0.0, 0.15)),),
    cameras=("camera", endoscope_camera.NAME),
    time_limit_s=60.0,
    settle_steps=SETTLE_STEPS,
    fields=(
        Field("block.p", 3, "point"),
        Field("block.R", 6, "rot6d"),
        Field("target.p", 3, "point"),
    ),
    labels=("source", "target"),
    stages=STAGES,
    text=text.TEXT,
    expert_version=2,
    experts={
        "default": "starjax.tasks.peg_transfer.expert:AGENT",
        "one_wall": "starjax.tasks.peg_transfer.expert:WITH_ONE_WALL",
    },
    graspable=("wall0", "wall1", "wall2"),
    bind=bind,
    sample=sample,
    tips=lambda bound, layout, p_trocars: layout.tip[None],
    place_objects=place_objects,
    measure=measure,
    status=status,
    state=state,
    relative=relative,
    label=lambda layout: {"source": layout.source, "target": layout.target},
    colours=colours,
    obstacles=obstacles,
    is_sound=is_sound,
    outline=text.outline,
    endoscope=workspaces.BOARD_ENDOSCOPE,
)
