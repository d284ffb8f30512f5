"""Needle pick: a suture needle is grasped from foam by friction, lifted and held. Lengths in m.

Needle frame: origin at its centre of mass, the arc in the x-y plane, z up as it lies.
"""

from typing import TYPE_CHECKING, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.core.types import Pose
from starjax.sim import bodies, endoscope_camera, workspaces
from starjax.sim.task import Field, Outline, SimReadings, Slot, Task, TaskStatus, TaskText
from starjax.tasks import outlines

if TYPE_CHECKING:  # a robot loads tasks without the simulator
    import mujoco

# The needle, as in needle_pick.xml (a test holds these to the compiled model).
SEGMENTS = 7  # for the wire; the last one ends in the point
RADIUS = 0.00828  # radius of the arc
SWEEP = np.pi  # rad

# Where an episode begins.
SPREAD = (0.035, 0.025)  # spread of the needle's centre, either way
TIP_HOME = (0.0, 0.0, 0.05)
TIP_SPREAD = 0.01  # each axis, at most

# Strict success: lifted, held by the jaws, without slip, for SETTLE_STEPS control steps (2 s).
LIFT = 0.020
SLIP = 0.0005
SETTLE_STEPS = 60

STAGES = ("approach", "grasped", "lifted", "held", "done")
NEAR = 0.03  # scale of distances in rewards and features
FLOOR = -0.0035  # the foam yields to the pads: a straight tool leans by up to 40 degrees
# Beyond these the simulation has diverged.
MAX_SPEED = 20.0  # m/s; a flicked needle is fast
# m; a needle on its edge has no rolling friction: lost on the floor it rolls 2 m in 40 s.
MAX_DISTANCE = 100.0


@flax.struct.dataclass
class NeedleLayout:
    """Draws at reset: pose_world_needle, and the tip's start `[3]` m."""

    needle: Pose
    tip: jax.Array


@flax.struct.dataclass
class NeedleMeasurements:
    """Measurements of one moment.

    Attributes:
      needle: pose_world_needle.
      tip: `[3]` m, the tool's tip.
      touch: the jaws hold some of the wire.
      sticks: the jaws touch the segment with the point.
      grip: `[3]` m, the tip in the needle's frame at the start of the present hold.
      slip: m, the tip's distance from `grip`.
    """

    needle: Pose
    tip: jax.Array
    touch: jax.Array
    sticks: jax.Array
    grip: jax.Array
    slip: jax.Array


class NeedleBound(NamedTuple):
    """Ids and shape in the compiled model.

    Attributes:
      needle, dof: first index of the needle's coordinates in qpos and qvel.
      height: m, of the resting needle's centre.
      point: geom ids of the segment with the point.
      pads: geom ids of the jaws' pads.
    """

    needle: int
    dof: int
    height: float
    point: np.ndarray
    pads: np.ndarray


def segments() -> tuple[np.ndarray, np.ndarray]:
    """Returns centres `[K, 3]` m and tangents `[K, 3]` of the segments in the needle's frame."""
    half = SWEEP / SEGMENTS / 2
    middle = (np.arange(SEGMENTS) - (SEGMENTS - 1) / 2) * 2 * half  # rad on the arc, symmetric
    zero = np.zeros(SEGMENTS)
    # Middles of chords: inside the arc
    centres = RADIUS * np.cos(half) * np.stack([np.cos(middle), np.sin(middle), zero], -1)
    tangents = np.stack([-np.sin(middle), np.cos(middle), zero], -1)
    centres = centres - centres.mean(0)  # origin at the centre of mass
    return centres.astype(np.float32), tangents.astype(np.float32)


def bind(m: "mujoco.MjModel") -> NeedleBound:
    """Resolves the ids of the needle and the pads."""
    pads = [g for g in range(m.ngeom) if "/pad_" in m.geom(g).name]
    return NeedleBound(
        needle=int(m.joint("needle").qposadr[0]),
        dof=int(m.joint("needle").dofadr[0]),
        height=float(m.body("needle").pos[2]),
        point=np.array([m.geom(f"wire{SEGMENTS - 1}{side}").id for side in "ab"]),
        pads=np.array(pads),
    )


def sample(bound: NeedleBound, key: jax.Array) -> NeedleLayout:
    """Draws the needle's position and yaw, and the tip's start."""
    key_place, key_yaw, key_tip = jax.random.split(key, 3)
    xy = jax.random.uniform(key_place, (2,), minval=-1.0) * jnp.array(SPREAD)
    yaw = jax.random.uniform(key_yaw, minval=-jnp.pi, maxval=jnp.pi)
    tip = jnp.array(TIP_HOME) + jax.random.uniform(
        key_tip, (3,), minval=-TIP_SPREAD, maxval=TIP_SPREAD
    )
    return NeedleLayout(Pose(rcm.rotation_z(yaw), jnp.append(xy, bound.height)), tip)


def place_objects(bound: NeedleBound, qpos: jax.Array, layout: NeedleLayout) -> jax.Array:
    """Places the needle."""
    coords = bodies.upright_coords(layout.needle)
    return qpos.at[bound.needle : bound.needle + 7].set(coords)


def measure(
    bound: NeedleBound,
    layout: NeedleLayout,
    readings: SimReadings,
    before: NeedleMeasurements | None,
) -> NeedleMeasurements:
    """Measures the needle and its slip in the jaws since it was lifted."""
    needle = bodies.free_pose(readings.qpos, bound.needle)
    tip = jax.tree.map(lambda leaf: leaf[0], readings.pose)
    here = needle.R.T @ (tip.p - needle.p)
    touch = readings.touch[0]
    is_up = touch & (needle.p[2] > bound.height + LIFT)
    grip = here
    if before is not None:  # a hold restarts once the needle has slipped too far
        was_up = before.touch & (before.needle.p[2] > bound.height + LIFT)
        grip = jnp.where(is_up & was_up & (before.slip < SLIP), before.grip, here)
    return NeedleMeasurements(
        needle=needle,
        tip=tip.p,
        touch=touch,
        sticks=bodies.touch(readings.contacts, bound.point, bound.pads),
        grip=grip,
        slip=jnp.linalg.norm(here - grip),
    )


def status(
    bound: NeedleBound, layout: NeedleLayout, measurements: NeedleMeasurements
) -> TaskStatus:
    """Tests strict success (lifted, held, without slip) and loose success (lifted)."""
    height = measurements.needle.p[2] - bound.height
    lifted = height > LIFT
    # A point that sticks in a pad would pass for a hold.
    success_now = lifted & measurements.touch & (measurements.slip < SLIP) & ~measurements.sticks
    stage = jnp.where(measurements.touch, 1, 0)
    stage = jnp.where(measurements.touch & lifted, 2, stage)
    stage = jnp.where(success_now, 3, stage).astype(jnp.int32)
    off = jnp.linalg.norm(measurements.needle.p - measurements.tip)
    fraction = jnp.where(
        measurements.touch, jnp.clip(height / LIFT, 0.0, 1.0), jnp.exp(-off / NEAR)
    )
    reward = jnp.where(success_now, 1.0, (stage + fraction) / (len(STAGES) - 1))
    return TaskStatus(success_now, lifted, jnp.zeros((), bool), stage, jnp.minimum(reward, 1.0))


def state(bound: NeedleBound, layout: NeedleLayout, measurements: NeedleMeasurements) -> jax.Array:
    """Returns `[9]`: the needle's position and rotation."""
    return jnp.concatenate([measurements.needle.p, rcm.rot6d_encode(measurements.needle.R)])


def relative(state: jax.Array, tips: jax.Array) -> jax.Array:
    """Returns `[..., 6]`: from the tip to the needle, in the world's and in the needle's frame."""
    off = state[..., :3] - tips[..., 0, :]
    needle = rcm.rot6d_decode(state[..., 3:9])
    # R' off: in the needle
    turned = jnp.einsum("...ji,...j->...i", needle, off, precision="highest")
    return jnp.concatenate([off, turned], axis=-1) / NEAR


def is_sound(bound: NeedleBound, qpos: jax.Array, qvel: jax.Array) -> jax.Array:
    """Returns False once the needle's simulation has diverged."""
    return bodies.is_sound(qpos, qvel, bound.needle, bound.dof, MAX_SPEED, MAX_DISTANCE)


TEXT = TaskText(
    title="needle pick",
    done="picked up the needle",
    strict="lifted by 20 mm and held for 2 s without slipping by more than 0.5 mm, its point free, "
    "in time",
    loose="the needle was lifted by 20 mm, held or thrown",
    nearly="needle lifted, but it slipped or was not held for 2 s",
    collided="pressed jaws or shaft into the foam",
    ground="the foam",
    goal="the needle must be lifted",
)


def outline(m: "mujoco.MjModel") -> Outline:
    """Returns the foam's rectangle."""
    return Outline((outlines.rectangle(m, "foam"),), ())


TASK = Task(
    name="needle_pick",
    mjcf="tasks/needle_pick/needle_pick.xml",
    slots=(Slot(workspace="board", p_world_ref=(0.0, 0.0, 0.15)),),
    cameras=("camera", endoscope_camera.NAME),
    time_limit_s=30.0,
    settle_steps=SETTLE_STEPS,
    fields=(Field("needle.p", 3, "point"), Field("needle.R", 6, "rot6d")),
    stages=STAGES,
    text=TEXT,
    expert_version=2,
    experts={"default": "starjax.tasks.needle_pick.expert:AGENT"},
    graspable=tuple(f"wire{k}{side}" for k in range(SEGMENTS) for side in "ab"),
    bind=bind,
    sample=sample,
    tips=lambda bound, layout, p_trocars: layout.tip[None],
    place_objects=place_objects,
    measure=measure,
    status=status,
    state=state,
    relative=relative,
    floor=FLOOR,
    is_sound=is_sound,
    outline=outline,
    endoscope=workspaces.BOARD_ENDOSCOPE,
)
