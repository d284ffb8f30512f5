"""Suture throw: a needle is picked up, driven, let go, taken by its point and pulled through.

Needle, pad and marks are those of needle drive. The needle begins in a block at the pad's edge,
which lets it go to the jaws that hold it; its tail leads a thread. Lengths in m.
"""

from functools import partial

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.addons.suture import thread
from starjax.addons.suture.needle_drive import grasps
from starjax.addons.suture.needle_drive import task as driven
from starjax.addons.suture.tissue import driving
from starjax.addons.suture.tissue import needle as needles
from starjax.addons.suture.tissue.needle import Bite
from starjax.core.types import Pose
from starjax.sim import bodies
from starjax.sim.task import (
    CONTROL_HZ,
    Coupling,
    Field,
    SimReadings,
    StepReadings,
    TaskStatus,
    TaskText,
)
from starjax.tasks import rewards

SIZE = needles.CT1
BITES = (0.008, 0.010)  # m between the marks: the wrist turns such a bite to 6 mm of wire out
# The block holds the needle like jaws at this tip, straight down, with a part of their force.
R_BLOCK = np.diag([1.0, -1.0, -1.0]).astype(np.float32)
P_BLOCK = np.array([0.03, 0.012, 0.022], np.float32)
BLOCK_GRIP = -0.3
GROUND = thread.RADIUS
# The thread lies along a circle around the marks, on either side.
CURL = 40.0  # 1/m
HEADING_SPREAD = float(np.deg2rad(20.0))

PULLED = 0.050  # m of thread out of the exit
ON_POINT = 0.5  # part of the arc from its middle to the point: beyond it jaws hold the point's half
SETTLE_STEPS = 15
STALLED_S = 7.0  # a second grasp of the point takes 5.3 s
DEMO_STEPS = round(50 * CONTROL_HZ)  # enough for the expert and a few second attempts
STAGES = ("approach", "picked", "inside", "out", "taken", "through", "done")


@flax.struct.dataclass
class ThrowLayout:
    """Draws at reset: the bite, the tip's start `[3]` m, the thread's heading (rad), curl (1/m)."""

    bite: Bite
    tip: jax.Array
    heading: jax.Array
    curl: jax.Array


@flax.struct.dataclass
class ThrowMeasurements:
    """Measurements of one moment.

    Attributes:
      drive: those of needle drive.
      thread: the thread.
      in_block: bool, the block holds the needle.
      by_point: bool, the jaws hold the point's half of a needle whose point is out.
      is_through: bool, the whole needle has passed the pad.
      pulled: m of thread out of the exit.
    """

    drive: driven.DriveMeasurements
    thread: thread.Thread
    in_block: jax.Array
    by_point: jax.Array
    is_through: jax.Array
    pulled: jax.Array


def sample(bound: driven.DriveBound, key: jax.Array) -> ThrowLayout:
    """Draws the marks, the tip's start and the way of the thread."""
    key_drive, key_side, key_heading = jax.random.split(key, 3)
    drawn = driven.sample(BITES, bound, key_drive)
    side = jnp.where(jax.random.bernoulli(key_side), 1.0, -1.0)
    spread = HEADING_SPREAD * jax.random.uniform(key_heading, minval=-1.0)
    return ThrowLayout(drawn.bite, drawn.tip, side * jnp.pi / 2 + spread, side * CURL)


def begin(
    bound: driven.DriveBound, layout: ThrowLayout, qpos: jax.Array, tips: Pose
) -> tuple[jax.Array, driving.Tissue]:
    """Puts the needle into the block."""
    held = grasps.grasp(SIZE)
    R = jnp.asarray(R_BLOCK)
    pose = Pose(R @ held.R, jnp.asarray(P_BLOCK) + R @ held.p)
    start = bound.needle
    qpos = qpos.at[start : start + 7].set(bodies.free_coords(pose))
    return qpos, driving.begin(SIZE, _with_block(tips), pose, jnp.array([False, True]))


def forces(
    bound: driven.DriveBound, layout: ThrowLayout, tissue: driving.Tissue, motion: StepReadings
) -> tuple[jax.Array, driving.Tissue]:
    """Returns the forces of pad, jaws and block."""
    own = slice(bound.dof, bound.dof + 6)
    block = jnp.where(tissue.patches.is_held[0], 1.0, BLOCK_GRIP)  # lets go
    twist = jnp.concatenate([motion.jacobian @ motion.qvel, jnp.zeros((1, 6))])
    found, tissue = driving.step(
        SIZE,
        bound.body,
        tissue,
        bodies.free_pose(motion.qpos, bound.needle),
        motion.qvel[own],
        driving.Tips(_with_block(motion.pose), twist, jnp.append(motion.gripper, block)),
        motion.timestep,
    )
    on_arms = jnp.einsum("aiv,ai->v", motion.jacobian, found.tips[:1])
    return on_arms.at[own].add(found.needle), tissue


def _with_block(tips: Pose) -> Pose:
    """Returns the poses `[2]` of the tip and of the block's hold."""
    R, p = jnp.asarray(R_BLOCK)[None], jnp.asarray(P_BLOCK)[None]
    return Pose(jnp.concatenate([tips.R, R]), jnp.concatenate([tips.p, p]))


def _driven(layout: ThrowLayout) -> driven.DriveLayout:
    return driven.DriveLayout(layout.bite, layout.tip)


def measure(
    bound: driven.DriveBound,
    layout: ThrowLayout,
    readings: SimReadings,
    before: ThrowMeasurements | None,
) -> ThrowMeasurements:
    """Measures the needle, its hole and its hold, and moves the thread on."""
    tissue: driving.Tissue = readings.memory
    drive = driven.measure(bound, _driven(layout), readings, None)
    made = tissue.hole
    tail = needles.point_at(SIZE, drive.needle, jnp.asarray(-SIZE.end))
    way = thread.Hole(made.entry, made.exit, made.has_exited)
    if before is None:
        led = thread.laid(tail, layout.heading, layout.curl, GROUND)
    else:
        led = thread.advance(before.thread, tail, way, GROUND, 1.0 / CONTROL_HZ)
    angle, _, _ = needles.coordinates(SIZE, drive.needle, drive.tip)
    return ThrowMeasurements(
        drive=drive,
        thread=led,
        in_block=tissue.patches.is_held[1],
        by_point=drive.held & made.has_exited & (angle > ON_POINT * SIZE.end),
        is_through=made.is_through,
        pulled=jnp.maximum(led.passed - thread.channel(way), 0.0),
    )


def turn_out(turn: jax.Array) -> jax.Array:
    """Returns a turn (rad) on the way out: the tail is past half a turn, and angles count on."""
    return jnp.where(turn < 0.0, turn + 2.0 * jnp.pi, turn)


def status(bound: driven.DriveBound, layout: ThrowLayout, now: ThrowMeasurements) -> TaskStatus:
    """Tests strict success (marks, force, thread, no collision) and loose (needle through)."""
    drive = now.drive
    on_marks = (drive.entry_off < driven.ON_MARK) & (drive.exit_off < driven.ON_MARK)
    is_gentle = (drive.max_force < driven.MAX_FORCE) & ~drive.collided
    is_pulled = now.is_through & drive.held & (now.pulled > PULLED)
    success_now = is_pulled & on_marks & is_gentle
    parts = drive.held, drive.is_inside, drive.has_exited, now.by_point, now.is_through
    stage = rewards.last_reached(*parts, success_now)
    goals = jnp.stack([drive.tip - drive.needle.p, drive.point - layout.bite.entry])
    near = jnp.exp(-jnp.linalg.norm(goals, axis=-1) / driven.NEAR)
    share = jnp.where(stage < 2, near[jnp.minimum(stage, 1)], 0.0)
    turned = turn_out(needles.turn_on(SIZE, layout.bite, drive.needle)) / SIZE.sweep
    share = jnp.where(now.by_point & drive.is_inside, jnp.clip(turned, 0.0, 1.0), share)
    share = jnp.where(now.is_through, jnp.clip(now.pulled / PULLED, 0.0, 1.0), share)
    reward = jnp.where(success_now, 1.0, (stage + 0.9 * share) / (len(STAGES) - 1))
    lost = ~drive.held & ~now.in_block & ~drive.is_inside
    return TaskStatus(success_now, now.is_through, lost, stage, reward)


def state(bound: driven.DriveBound, layout: ThrowLayout, now: ThrowMeasurements) -> jax.Array:
    """Returns `[18]`: needle drive's, 1 once the needle is through, the fraction of thread."""
    through = jnp.where(now.is_through, 1.0, 0.0)
    pulled = jnp.clip(now.pulled / PULLED, 0.0, 1.0)
    return jnp.concatenate(
        [driven.state(bound, _driven(layout), now.drive), jnp.stack([through, pulled])]
    )


def relative(state: jax.Array, tips: jax.Array) -> jax.Array:
    """Returns `[..., 21]`: needle drive's, the point from tip and marks, the tip from the needle.

    The last is in the needle's frame, in which a grasp is always at the same place.
    """
    needle = Pose(rcm.rot6d_decode(state[..., 3:9]), state[..., :3])
    point = needle.p + needle.R @ needles.offset_at(SIZE, jnp.asarray(SIZE.end))
    tip = tips[..., 0, :]
    seen = jnp.einsum("...ji,...j->...i", needle.R, tip - needle.p)
    parts = [point - tip, point - state[..., 9:12], point - state[..., 12:15], seen]
    return jnp.concatenate([driven.relative(state, tips), *(x / driven.NEAR for x in parts)], -1)


TEXT = TaskText(
    title="suture throw",
    done="threw the suture",
    strict="in at one mark and out at the other within 1 mm, with at most 0.4 N across the hole, "
    "needle taken out by its point, 50 mm of thread pulled through, nothing touched by shaft or "
    "wrist, in time",
    loose="the whole needle passed the pad",
    nearly="needle passed through, but off a mark, with force, a collision or too little thread",
    collided="pressed the wrist or the shaft into the pad",
    ground="the pad",
    goal="the needle goes in at the dark mark and out at the blue one",
    lost="the needle was dropped",
)


TASK = driven.TASK._replace(
    name="suture_throw",
    mjcf="tasks/suture_throw/suture_throw.xml",
    time_limit_s=60.0,
    settle_steps=SETTLE_STEPS,
    fields=(*driven.TASK.fields, Field("through", 1, "unit"), Field("pulled", 1, "unit")),
    stages=STAGES,
    text=TEXT,
    expert_version=2,
    experts={"default": "starjax.addons.suture.suture_throw.expert:AGENT"},
    bind=partial(driven.bind, SIZE),
    sample=sample,
    measure=measure,
    status=status,
    state=state,
    relative=relative,
    coupling=Coupling(begin, forces),
    thread=lambda measurements: measurements.thread.p,
    least_steps=DEMO_STEPS,
    stalled_s=STALLED_S,
)
