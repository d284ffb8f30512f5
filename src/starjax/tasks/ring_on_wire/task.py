"""Ring on wire: a ring that hangs on a bent wire is carried along without touching it.

Lengths in m. Ring frame: origin at its centre, y along its normal, z towards its tab. The wire lies
in the plane x = 0; it is the same from either end, and an episode begins at one of them.
"""

from typing import TYPE_CHECKING, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.core.types import Pose
from starjax.sim import bodies, endoscope_camera, workspaces
from starjax.sim.task import Capsules, Field, Outline, SimReadings, Slot, Task, TaskStatus, TaskText
from starjax.tasks import outlines, rewards
from starjax.tasks.peg_transfer.task import is_at_rest

if TYPE_CHECKING:  # a robot loads tasks without the simulator
    import mujoco

# As in ring_on_wire.xml (a test holds these to the compiled model).
# y of the wire's corners
BENDS = (-0.045981, -0.025981, -0.01299, 0.0, 0.01299, 0.025981, 0.045981)
HEIGHTS = (0.022, 0.022, 0.0295, 0.022, 0.0295, 0.022, 0.022)  # z of them
TAB = 0.0110  # from the ring's centre to where its tab is held
HANG = 0.00414  # height of the hanging ring's centre below the wire's axis

# Where an episode begins.
START = 0.037  # from the wire's middle
START_SPREAD = 0.0035
YAW = 0.25  # rad, either way
TIP_HOME = (0.0, 0.0, 0.056)
TIP_SPREAD = 0.008  # each axis, at most

# Strict success: beyond the bent part, hanging, released, at rest for SETTLE_STEPS control steps.
END = 0.029
HANG_TOLERANCE = 0.003
MAY_TOUCH = 9  # control steps over the bent part: 0.3 s
SETTLE_STEPS = 10

STAGES = ("approach", "grasped", "lifted", "on the way", "at the end", "done")
LIFTED = 0.002  # above where it hangs
NEAR = 0.03  # scale of distances in rewards and features
GOAL_RGB = (0.98, 0.62, 0.1)
# Beyond these the simulation has diverged.
MAX_SPEED = 5.0  # m/s
MAX_DISTANCE = 0.3


@flax.struct.dataclass
class RingLayout:
    """Draws at reset.

    Attributes:
      start: int32, the ring's end of the wire: 0 at y < 0, 1 at y > 0.
      way: `[]`, 1 or -1, direction along y to the other end.
      ring: pose_world_ring.
      tip: `[3]` m, the tip's start.
    """

    start: jax.Array
    way: jax.Array
    ring: Pose
    tip: jax.Array


@flax.struct.dataclass
class RingMeasurements:
    """Measurements of one moment and history of the episode.

    Attributes:
      ring: pose_world_ring.
      velocity: `[6]` of the ring, m/s and rad/s.
      tip: `[3]` m.
      touch: the jaws touch the tab.
      rubs: the ring touches the wire.
      rubbed: int32, control steps with such a touch over the bent part.
    """

    ring: Pose
    velocity: jax.Array
    tip: jax.Array
    touch: jax.Array
    rubs: jax.Array
    rubbed: jax.Array


class RingBound(NamedTuple):
    """Ids and shapes in the compiled model.

    Attributes:
      ring, dof: first index of the ring's coordinates in qpos and qvel.
      tube, wire: geom ids of the ring's tube, and of the wire with its posts.
      ends: `[2, 2]` geom ids, the last piece and the post of either end.
      pieces: `[K, 2, 3]` m, axes of wire and posts.
      radius: m, of wire and posts.
    """

    ring: int
    dof: int
    tube: np.ndarray
    wire: np.ndarray
    ends: np.ndarray
    pieces: np.ndarray
    radius: float


def bind(m: "mujoco.MjModel") -> RingBound:
    """Resolves the ids of ring and wire."""
    names = [m.geom(g).name for g in range(m.ngeom)]
    wire = [g for g, name in enumerate(names) if name.startswith(("wire", "post"))]
    last = len(BENDS) - 2
    ends = [[f"wire{last}", "post1"], ["wire0", "post0"]]  # by the episode's start
    pieces = np.array([outlines.capsule_ends(m.geom(g)) for g in wire], np.float32)
    return RingBound(
        ring=int(m.joint("ring").qposadr[0]),
        dof=int(m.joint("ring").dofadr[0]),
        tube=np.array([g for g, name in enumerate(names) if name.startswith("ring")]),
        wire=np.array(wire),
        ends=np.array([[m.geom(name).id for name in pair] for pair in ends]),
        pieces=pieces,
        radius=float(m.geom(wire[0]).size[0]),
    )


def height(y: jax.Array) -> jax.Array:
    """Returns the height (m) of the wire's axis at `y` `[...]` m."""
    return jnp.interp(y, jnp.array(BENDS), jnp.array(HEIGHTS))


def sample(bound: RingBound, key: jax.Array) -> RingLayout:
    """Draws the end, the ring's position and yaw, and the tip's start."""
    key_start, key_place, key_yaw, key_tip = jax.random.split(key, 4)
    start = jax.random.randint(key_start, (), 0, 2)
    way = 1.0 - 2.0 * start  # direction along y: +1 or -1
    aside = jax.random.uniform(key_place, minval=-START_SPREAD, maxval=START_SPREAD)
    y = -way * START + aside
    yaw = jax.random.uniform(key_yaw, minval=-YAW, maxval=YAW)
    p = jnp.stack([jnp.zeros(()), y, height(y) - HANG])
    tip = jnp.array(TIP_HOME) + jax.random.uniform(
        key_tip, (3,), minval=-TIP_SPREAD, maxval=TIP_SPREAD
    )
    return RingLayout(start, way, Pose(rcm.rotation_z(yaw), p), tip)


def place_objects(bound: RingBound, qpos: jax.Array, layout: RingLayout) -> jax.Array:
    """Places the ring on the wire."""
    return qpos.at[bound.ring : bound.ring + 7].set(bodies.upright_coords(layout.ring))


def measure(
    bound: RingBound, layout: RingLayout, readings: SimReadings, before: RingMeasurements | None
) -> RingMeasurements:
    """Measures the ring and counts its touches of the wire."""
    ring = bodies.free_pose(readings.qpos, bound.ring)
    rubs = bodies.touch(readings.contacts, bound.tube, bound.wire)
    rubbed = jnp.zeros((), jnp.int32)
    if before is not None:
        # Straight ends are free: the ring hangs on them before and after.
        rubbed = before.rubbed + (rubs & (jnp.abs(ring.p[1]) < -BENDS[1]))
    return RingMeasurements(
        ring=ring,
        velocity=readings.qvel[bound.dof : bound.dof + 6],
        tip=readings.pose.p[0],
        touch=readings.touch[0],
        rubs=rubs,
        rubbed=rubbed,
    )


def status(bound: RingBound, layout: RingLayout, measurements: RingMeasurements) -> TaskStatus:
    """Tests strict success (at the end, few touches, released, at rest) and loose (at the end)."""
    p, way = measurements.ring.p, layout.way * measurements.ring.p[1]
    raised = p[2] - (height(p[1]) - HANG)  # m above where it would hang
    at_end = (way > END) & (way < -BENDS[0])
    hangs = at_end & (jnp.abs(raised) < HANG_TOLERANCE)  # let go of, it hangs on the wire
    may = measurements.rubbed <= MAY_TOUCH
    success_now = hangs & may & ~measurements.touch & is_at_rest(measurements.velocity)
    touch, is_lifted = measurements.touch, measurements.touch & (raised > LIFTED)
    is_past_bend = is_lifted & (way > BENDS[1])
    stage = rewards.last_reached(touch, is_lifted, is_past_bend, at_end, success_now)
    to_tab = jnp.linalg.norm(p + TAB * measurements.ring.R[:, 2] - measurements.tip)
    terms = {
        "approach": rewards.nearness(to_tab, NEAR),
        "grasped": rewards.nearness(jnp.maximum(END - way, 0.0), NEAR),
    }
    reward = rewards.staged(STAGES, terms, stage, success_now)
    return TaskStatus(success_now, at_end, ~may, stage, reward)


def state(bound: RingBound, layout: RingLayout, measurements: RingMeasurements) -> jax.Array:
    """Returns `[12]`: the ring's position and rotation, and its goal's position."""
    goal = jnp.stack([jnp.zeros(()), layout.way * START, jnp.array(HEIGHTS[-1] - HANG)])
    return jnp.concatenate([measurements.ring.p, rcm.rot6d_encode(measurements.ring.R), goal])


def relative(state: jax.Array, tips: jax.Array) -> jax.Array:
    """Returns `[..., 11]`: differences of the tip, the ring, the wire and the goal.

    From the tip to the tab in the world's and in the ring's frame, the ring's height above the
    wire, its normal across the wire's plane, and from the ring to the goal.
    """
    p, R, goal = state[..., :3], rcm.rot6d_decode(state[..., 3:9]), state[..., 9:12]
    off = p + TAB * R[..., 2] - tips[..., 0, :]
    turned = jnp.einsum("...ji,...j->...i", R, off, precision="highest")
    above = (p[..., 2] - height(p[..., 1]))[..., None] / HANG
    return jnp.concatenate([off / NEAR, turned / NEAR, above, R[..., :1, 1], (goal - p) / NEAR], -1)


def colours(bound: RingBound, layout: RingLayout, rgb: jax.Array) -> jax.Array:
    """Marks the ring's goal."""
    return rgb.at[jnp.asarray(bound.ends)[layout.start]].set(jnp.array(GOAL_RGB))


def obstacles(bound: RingBound, layout: RingLayout, measurements: RingMeasurements) -> Capsules:
    """Returns the wire and its posts."""
    start, end = jnp.moveaxis(jnp.asarray(bound.pieces), 1, 0)
    return Capsules(start, end, jnp.full(len(bound.pieces), bound.radius))


def is_sound(bound: RingBound, qpos: jax.Array, qvel: jax.Array) -> jax.Array:
    """Returns False once the ring's simulation has diverged."""
    return bodies.is_sound(qpos, qvel, bound.ring, bound.dof, MAX_SPEED, MAX_DISTANCE)


TEXT = TaskText(
    title="ring on wire",
    done="carried the ring along the wire to its end",
    strict="at the marked end of the wire, released and at rest, having touched the bent part for "
    "0.3 s at most, in time",
    loose="the ring came to the marked end, however often it touched the wire",
    nearly="ring at the marked end, but not released and at rest there",
    collided="touched the base or the wire with the shaft or an arm",
    ground="the base",
    goal="the ring belongs at the marked end of the wire",
    lost="the ring touched the bent part of the wire for longer than 0.3 s",
)


def outline(m: "mujoco.MjModel") -> Outline:
    """Returns the base's rectangle and the wire."""
    pieces = tuple(map(outlines.capsule_ends, outlines.named(m, "wire", "post")))
    return Outline((outlines.rectangle(m, "base"),), pieces)


TASK = Task(
    name="ring_on_wire",
    mjcf="tasks/ring_on_wire/ring_on_wire.xml",
    slots=(Slot(workspace="wire", p_world_ref=(0.0, 0.0, 0.15), tool="grasper_wide"),),
    cameras=("camera", endoscope_camera.NAME),
    time_limit_s=60.0,
    settle_steps=SETTLE_STEPS,
    fields=(
        Field("ring.p", 3, "point"),
        Field("ring.R", 6, "rot6d"),
        Field("goal.p", 3, "point"),
    ),
    labels=("start",),
    stages=STAGES,
    text=TEXT,
    expert_version=2,
    experts={"default": "starjax.tasks.ring_on_wire.expert:AGENT"},
    graspable=("tab0", "tab1"),
    bind=bind,
    sample=sample,
    tips=lambda bound, layout, p_trocars: layout.tip[None],
    place_objects=place_objects,
    measure=measure,
    status=status,
    state=state,
    relative=relative,
    label=lambda layout: {"start": layout.start},
    colours=colours,
    obstacles=obstacles,
    is_sound=is_sound,
    outline=outline,
    endoscope=workspaces.WIRE_ENDOSCOPE,
)
