"""Needle drive: a held needle goes through a pad, in at one mark and out at another. Lengths in m.

The needle begins in the jaws, the same way at every trocar. Pad and jaws act on it through the
model of `suture.tissue`. The needle's path is an arc, so the point comes out at the mark only if
the jaws turn it about the arc's centre: this needs a tool with a wrist.
"""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.addons.suture.needle_drive import grasps, text
from starjax.addons.suture.tissue import driving, hole
from starjax.addons.suture.tissue import needle as needles
from starjax.addons.suture.tissue.needle import Bite, Needle
from starjax.core.types import Pose
from starjax.sim import bodies, endoscope_camera, workspaces
from starjax.sim.task import Coupling, Field, SimReadings, Slot, StepReadings, Task, TaskStatus

if TYPE_CHECKING:  # a robot loads tasks without the simulator
    import mujoco

# Draws. Directions in which one grasp serves every trocar with the roll within 1.6 rad of its zero.
SPREAD = 0.006  # spread of the bite's middle, either way
DIRECTION = (float(np.deg2rad(150.0)), float(np.deg2rad(270.0)))
TIP_HOME = (0.0, 0.0, 0.05)
TIP_SPREAD = 0.008  # each axis, at most

# Strict success, for SETTLE_STEPS control steps.
ON_MARK = 0.001  # for entry and exit
EMERGED = 0.003  # length of wire, enough to be taken
# N across the hole: at it a point of the hole has given way by the tolerance of the marks.
MAX_FORCE = hole.ACROSS * ON_MARK
SETTLE_STEPS = 15

STAGES = ("approach", "inside", "out", "done")
NEAR = 0.03  # scale of distances in rewards and features
# Beyond these the simulation has diverged.
MAX_SPEED = 20.0  # m/s
MAX_DISTANCE = 2.0


@flax.struct.dataclass
class DriveLayout:
    """Draws at reset: the bite, and the tip's start `[3]` m."""

    bite: Bite
    tip: jax.Array


@flax.struct.dataclass
class DriveMeasurements:
    """Measurements of one moment.

    Attributes:
      needle: pose_world_needle.
      point: `[3]` m, its point.
      tip: `[3]` m, the tool's tip.
      held, is_inside, has_exited, collided: bool.
      entry_off, exit_off: m, from the marks, once there is an entry and an exit.
      emerged: m, of wire that has left at the exit.
      max_force: N, the largest one across the hole so far.
    """

    needle: Pose
    point: jax.Array
    tip: jax.Array
    held: jax.Array
    is_inside: jax.Array
    has_exited: jax.Array
    collided: jax.Array
    entry_off: jax.Array
    exit_off: jax.Array
    emerged: jax.Array
    max_force: jax.Array


class DriveBound(NamedTuple):
    """Ids and sizes in the compiled model.

    Attributes:
      size: of the needle.
      needle, dof: first index of the needle's coordinates in qpos and qvel.
      body: its inertia.
      jaws: indices of the jaws' joints in qpos.
    """

    size: Needle
    needle: int
    dof: int
    body: driving.Body
    jaws: np.ndarray


def bind(size: Needle, m: "mujoco.MjModel") -> DriveBound:
    """Resolves the ids of the needle and the jaws."""
    joint, body = m.joint("needle"), m.body("needle")
    dof = int(joint.dofadr[0])
    bare = np.concatenate([np.repeat(body.mass, 3), body.inertia])
    jaws = [m.joint(j) for j in range(m.njnt) if "/tool/jaw" in m.joint(j).name]
    return DriveBound(
        size=size,
        needle=int(joint.qposadr[0]),
        dof=dof,
        body=driving.Body(bare + m.dof_armature[dof : dof + 6], float(body.mass[0])),
        jaws=np.array([jaw.qposadr[0] for jaw in jaws], int),
    )


def sample(bites: tuple[float, float], bound: DriveBound, key: jax.Array) -> DriveLayout:
    """Draws the marks, `bites` (m) apart, and the tip's start."""
    key_middle, key_way, key_bite, key_tip = jax.random.split(key, 4)
    middle = jax.random.uniform(key_middle, (2,), minval=-SPREAD, maxval=SPREAD)
    way = jax.random.uniform(key_way, minval=DIRECTION[0], maxval=DIRECTION[1])
    half = 0.5 * jax.random.uniform(key_bite, minval=bites[0], maxval=bites[1])
    along = half * jnp.stack([jnp.cos(way), jnp.sin(way)])
    tip = jnp.array(TIP_HOME) + jax.random.uniform(
        key_tip, (3,), minval=-TIP_SPREAD, maxval=TIP_SPREAD
    )
    return DriveLayout(Bite(jnp.append(middle - along, 0.0), jnp.append(middle + along, 0.0)), tip)


def begin(
    held: Pose, bound: DriveBound, qpos: jax.Array, tips: Pose
) -> tuple[jax.Array, driving.Tissue]:
    """Puts the needle between the closed jaws, with pose_tip_needle `held`."""
    tip = jax.tree.map(lambda leaf: leaf[0], tips)
    pose = Pose(tip.R @ held.R, tip.p + tip.R @ held.p)
    start = bound.needle
    qpos = qpos.at[start : start + 7].set(bodies.free_coords(pose)).at[bound.jaws].set(0.0)
    return qpos, driving.begin(bound.size, tips, pose, jnp.ones(1, bool))


def forces(
    bound: DriveBound, layout: DriveLayout, tissue: driving.Tissue, motion: StepReadings
) -> tuple[jax.Array, driving.Tissue]:
    """Returns the forces of pad and jaws on the needle and on the arm."""
    own = slice(bound.dof, bound.dof + 6)
    twist = motion.jacobian @ motion.qvel
    found, tissue = driving.step(
        bound.size,
        bound.body,
        tissue,
        bodies.free_pose(motion.qpos, bound.needle),
        motion.qvel[own],
        driving.Tips(motion.pose, twist, motion.gripper),
        motion.timestep,
    )
    on_arms = jnp.einsum("aiv,ai->v", motion.jacobian, found.tips)
    return on_arms.at[own].add(found.needle), tissue


def measure(
    bound: DriveBound,
    layout: DriveLayout,
    readings: SimReadings,
    before: DriveMeasurements | None,
) -> DriveMeasurements:
    """Measures the needle, its hold and its hole."""
    tissue: driving.Tissue = readings.memory
    needle, made = bodies.free_pose(readings.qpos, bound.needle), tissue.hole
    entered = made.is_inside | made.has_exited
    off = jnp.linalg.norm(made.entry - layout.bite.entry)
    exit_off = jnp.linalg.norm(made.exit - layout.bite.exit)
    return DriveMeasurements(
        needle=needle,
        point=needles.point_at(bound.size, needle, jnp.asarray(bound.size.end)),
        tip=readings.pose.p[0],
        held=tissue.patches.is_held[0],
        is_inside=made.is_inside,
        has_exited=made.has_exited,
        collided=jnp.zeros((), bool) if readings.collided is None else readings.collided,
        entry_off=jnp.where(entered, off, 0.0),
        exit_off=jnp.where(made.has_exited, exit_off, 0.0),
        emerged=hole.emerged(bound.size, needle, made),
        max_force=made.max_force,
    )


def status(bound: DriveBound, layout: DriveLayout, now: DriveMeasurements) -> TaskStatus:
    """Tests strict success (on both marks, gently, without a collision) and loose (through)."""
    is_out = now.has_exited & (now.emerged > EMERGED)
    on_marks = (now.entry_off < ON_MARK) & (now.exit_off < ON_MARK)
    success_now = is_out & on_marks & (now.max_force < MAX_FORCE) & ~now.collided
    stage = jnp.where(now.is_inside, 1, 0) + jnp.where(now.is_inside & now.has_exited, 1, 0)
    stage = jnp.where(success_now, 3, stage).astype(jnp.int32)
    goal = jnp.where(now.is_inside, layout.bite.exit, layout.bite.entry)
    near = jnp.exp(-jnp.linalg.norm(now.point - goal) / NEAR)
    out = jnp.clip(now.emerged / EMERGED, 0.0, 1.0)
    share = jnp.where(now.has_exited, 0.9 * out, 0.9 * near)
    reward = jnp.where(success_now, 1.0, (stage + share) / (len(STAGES) - 1))
    lost = ~now.held & ~now.is_inside
    return TaskStatus(success_now, now.has_exited, lost, stage, jnp.minimum(reward, 1.0))


def state(bound: DriveBound, layout: DriveLayout, now: DriveMeasurements) -> jax.Array:
    """Returns `[16]`: the needle, the marks, and 1 while the needle is in the pad."""
    needle = rcm.rot6d_encode(now.needle.R)
    inside = jnp.where(now.is_inside, 1.0, 0.0)
    return jnp.concatenate(
        [now.needle.p, needle, layout.bite.entry, layout.bite.exit, inside[None]]
    )


def relative(state: jax.Array, tips: jax.Array) -> jax.Array:
    """Returns `[..., 9]`: from the needle to the tip and to both marks."""
    needle = state[..., :3]
    parts = [tips[..., 0, :] - needle, state[..., 9:12] - needle, state[..., 12:15] - needle]
    return jnp.concatenate(parts, axis=-1) / NEAR


def still(layout: DriveLayout) -> Pose:
    """Returns the marks' poses `[2]`."""
    p = jnp.stack([layout.bite.entry, layout.bite.exit])
    return Pose(jnp.broadcast_to(jnp.eye(3), (2, 3, 3)), p)


def is_sound(bound: DriveBound, qpos: jax.Array, qvel: jax.Array) -> jax.Array:
    """Returns False once the needle's simulation has diverged."""
    return bodies.is_sound(qpos, qvel, bound.needle, bound.dof, MAX_SPEED, MAX_DISTANCE)


def _grasp(bound: DriveBound, bite: Bite) -> Pose:
    """Returns pose_tip_needle, the same for all bites."""
    return grasps.grasp(bound.size)


def make(
    name: str,
    size: Needle,
    bites: tuple[float, float],
    experts: Mapping[str, str],
    held: Callable[[DriveBound, Bite], Pose] = _grasp,
    **more: Any,
) -> Task:
    """Returns a task with a needle.

    Args:
      bites: m, range of distances between the marks.
      experts: variant -> `module:object`.
      held: pose_tip_needle at the start.
      more: further fields of the task.
    """
    return Task(
        name=name,
        mjcf=f"tasks/needle_drive/{name}.xml",
        slots=(
            Slot(workspace="board", p_world_ref=(0.0, 0.0, 0.15), arm="psm", tool="needle_driver"),
        ),
        cameras=("camera", "camera_near", endoscope_camera.NAME),
        time_limit_s=30.0,
        settle_steps=SETTLE_STEPS,
        fields=(
            Field("needle.p", 3, "point"),
            Field("needle.R", 6, "rot6d"),
            Field("entry.p", 3, "point"),
            Field("exit.p", 3, "point"),
            Field("inside", 1, "unit"),
        ),
        stages=STAGES,
        text=text.TEXT,
        expert_version=2,
        experts=experts,
        graspable=(),
        bind=lambda m: bind(size, m),
        sample=lambda bound, key: sample(bites, bound, key),
        tips=lambda bound, layout, p_trocars: layout.tip[None],
        measure=measure,
        status=status,
        state=state,
        relative=relative,
        is_sound=is_sound,
        still=still,
        coupling=Coupling(
            lambda bound, layout, qpos, tips: begin(held(bound, layout.bite), bound, qpos, tips),
            forces,
        ),
        outline=text.outline,
        endoscope=workspaces.BOARD_ENDOSCOPE,
        **more,
    )


EXPERT = "starjax.addons.suture.needle_drive.expert"
TASK = make("needle_drive", needles.CT1, (0.008, 0.014), {"default": f"{EXPERT}:AGENT"})
SMALL = make("needle_drive_sh", needles.SH, (0.008, 0.009), {"default": f"{EXPERT}:SMALL"})
