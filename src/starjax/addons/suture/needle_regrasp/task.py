"""Needle regrasp: a needle that lies tilted is taken as for driving, and held. Lengths in m.

The needle is that of needle pick, on a foam plate tilted by up to 30 degrees, at any yaw. For
driving it is held a third from its swage, square to the jaws: that fixes the tip's rotation, which
only a tool with a wrist can have at every trocar.
"""

from typing import TYPE_CHECKING, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.core.types import Pose
from starjax.sim import bodies, endoscope_camera, workspaces
from starjax.sim.task import SimReadings, Slot, Task, TaskStatus, TaskText
from starjax.tasks.needle_pick import task as pick

if TYPE_CHECKING:  # a robot loads tasks without the simulator
    import mujoco

MAX_TILT = float(np.deg2rad(30.0))
SPREAD = (0.015, 0.010)  # spread of the needle's centre on the plate, either way
TIP_HOME = (0.0, 0.0, 0.06)

# The grasp: fraction of the wire from its swage, and angle to a square one.
FRACTION, FRACTION_OFF = 1.0 / 3.0, 0.1
MAX_SKEW = float(np.deg2rad(15.0))

STAGES = ("approach", "grasped", "lifted", "held", "done")
# Centre of the arc in the needle's frame, whose origin is the centre of mass.
_HALF_SEGMENT = pick.SWEEP / pick.SEGMENTS / 2
_CENTRE = pick.segments()[0][pick.SEGMENTS // 2] - np.array(
    [pick.RADIUS * np.cos(_HALF_SEGMENT), 0.0, 0.0], np.float32
)


@flax.struct.dataclass
class RegraspLayout:
    """Draws at reset: pose_world_needle, the plate's hinges `[2]` rad, the tip's start `[3]` m."""

    needle: Pose
    tilt: jax.Array
    tip: jax.Array


@flax.struct.dataclass
class RegraspMeasurements:
    """Measurements of one moment.

    Attributes:
      pick: those of needle pick; slip counts from the present hold.
      fraction: of the wire, from the swage to the jaws.
      skew: rad, angle between the wire there and the jaws' x axis, either way.
    """

    pick: pick.NeedleMeasurements
    fraction: jax.Array
    skew: jax.Array


class RegraspBound(NamedTuple):
    """Ids in the compiled model.

    Attributes:
      pick: those of needle pick.
      bed, ctrl: `[2]` indices of the plate's hinges in qpos and ctrl.
      pivot: `[3]` m, of the plate.
    """

    pick: pick.NeedleBound
    bed: np.ndarray
    ctrl: np.ndarray
    pivot: np.ndarray


def bind(m: "mujoco.MjModel") -> RegraspBound:
    """Resolves the ids of the needle, the pads and the plate."""
    names = ("bed_x", "bed_y")
    return RegraspBound(
        pick=pick.bind(m),
        bed=np.array([m.joint(name).qposadr[0] for name in names]),
        ctrl=np.array([m.actuator(name).id for name in names]),
        pivot=np.array(m.body("bed").pos, np.float32),
    )


def sample(bound: RegraspBound, key: jax.Array) -> RegraspLayout:
    """Draws the plate's tilt, the needle's position and yaw on it, and the tip's start."""
    key_tilt, key_way, key_place, key_yaw, key_tip = jax.random.split(key, 5)
    tilt = jax.random.uniform(key_tilt, maxval=MAX_TILT)
    way = jax.random.uniform(key_way, minval=-jnp.pi, maxval=jnp.pi)
    # Hinges about x and then y whose plate leans by `tilt` towards `way`: its normal is
    # (sin b, -sin a cos b, cos a cos b).
    side = jnp.sin(tilt)
    b = jnp.arcsin(side * jnp.cos(way))
    a = jnp.arctan2(-side * jnp.sin(way), jnp.cos(tilt))
    xy = jax.random.uniform(key_place, (2,), minval=-1.0) * jnp.array(SPREAD)
    yaw = jax.random.uniform(key_yaw, minval=-jnp.pi, maxval=jnp.pi)
    tip = jnp.array(TIP_HOME) + jax.random.uniform(
        key_tip, (3,), minval=-pick.TIP_SPREAD, maxval=pick.TIP_SPREAD
    )
    R = _plate(a, b)
    p = jnp.asarray(bound.pivot) + R @ jnp.append(xy, bound.pick.height)
    return RegraspLayout(Pose(R @ rcm.rotation_z(yaw), p), jnp.stack([a, b]), tip)


def _plate(a: jax.Array, b: jax.Array) -> jax.Array:
    """Returns R_world_plate of its hinges (rad)."""
    (ca, sa), (cb, sb) = ((jnp.cos(x), jnp.sin(x)) for x in (a, b))
    zero = jnp.zeros(())
    rows = ([cb, zero, sb], [sa * sb, ca, -sa * cb], [-ca * sb, sa, ca * cb])
    return jnp.stack([jnp.stack(row) for row in rows])


def place_objects(bound: RegraspBound, qpos: jax.Array, layout: RegraspLayout) -> jax.Array:
    """Places the needle on the tilted plate."""
    start = bound.pick.needle
    coords = bodies.free_coords(layout.needle)
    return qpos.at[start : start + 7].set(coords).at[bound.bed].set(layout.tilt)


def drive(
    bound: RegraspBound, layout: RegraspLayout, ctrl: jax.Array, time: jax.Array
) -> jax.Array:
    """Holds the plate."""
    return ctrl.at[bound.ctrl].set(layout.tilt)


def measure(
    bound: RegraspBound,
    layout: RegraspLayout,
    readings: SimReadings,
    before: RegraspMeasurements | None,
) -> RegraspMeasurements:
    """Measures the needle, its slip, and the place and the squareness of the jaws on the wire."""
    last = None if before is None else before.pick
    found = pick.measure(_on_plate(bound, layout), _layout(layout), readings, last)
    tip = jax.tree.map(lambda leaf: leaf[0], readings.pose)
    angle = wire_angle(found.needle, tip.p)
    along = jnp.abs(wire_tangent(found.needle, angle) @ tip.R[:, 0])
    return RegraspMeasurements(
        pick=found,
        fraction=angle / pick.SWEEP + 0.5,
        skew=jnp.arccos(jnp.minimum(along, 1.0)),
    )


def wire_angle(needle: Pose, p: jax.Array) -> jax.Array:
    """Returns the angle (rad) about the arc's centre of a position `[3]` m, 0 half way."""
    x, y, _ = needle.R.T @ (p - needle.p) - jnp.asarray(_CENTRE)
    return jnp.arctan2(y, x)


def wire_point(needle: Pose, angle: jax.Array) -> jax.Array:
    """Returns the position `[3]` m of the wire at an angle."""
    out = jnp.stack([jnp.cos(angle), jnp.sin(angle), jnp.zeros(())])
    return needle.p + needle.R @ (jnp.asarray(_CENTRE) + pick.RADIUS * out)


def wire_tangent(needle: Pose, angle: jax.Array) -> jax.Array:
    """Returns the direction `[3]` of the wire at an angle, towards the point."""
    return needle.R @ jnp.stack([-jnp.sin(angle), jnp.cos(angle), jnp.zeros(())])


def _layout(layout: RegraspLayout) -> pick.NeedleLayout:
    return pick.NeedleLayout(layout.needle, layout.tip)


def _on_plate(bound: RegraspBound, layout: RegraspLayout) -> pick.NeedleBound:
    """Returns needle pick's record with the height at which this needle rests."""
    return bound.pick._replace(height=layout.needle.p[2])


def status(
    bound: RegraspBound, layout: RegraspLayout, measurements: RegraspMeasurements
) -> TaskStatus:
    """Tests strict success (needle pick's, and the grasp as for driving) and loose (lifted)."""
    held = pick.status(_on_plate(bound, layout), _layout(layout), measurements.pick)
    as_driving = is_as_for_driving(measurements)
    success_now = held.success_now & as_driving
    stage = jnp.where(as_driving, held.stage, jnp.minimum(held.stage, 2))
    share = held.reward * (len(STAGES) - 1) - held.stage  # part of the stage that is reached
    reward = (stage + jnp.clip(share, 0.0, 1.0)) / (len(STAGES) - 1)
    reward = jnp.where(success_now, 1.0, jnp.minimum(reward, 1.0))
    return held._replace(success_now=success_now, stage=stage, reward=reward)


def is_as_for_driving(measurements: RegraspMeasurements) -> jax.Array:
    """Returns True if the jaws are where a needle is held for driving, and square to it."""
    is_placed = jnp.abs(measurements.fraction - FRACTION) < FRACTION_OFF
    return is_placed & (measurements.skew < MAX_SKEW)


def state(
    bound: RegraspBound, layout: RegraspLayout, measurements: RegraspMeasurements
) -> jax.Array:
    """Returns `[9]`: the needle's position and rotation."""
    return pick.state(bound.pick, _layout(layout), measurements.pick)


def is_sound(bound: RegraspBound, qpos: jax.Array, qvel: jax.Array) -> jax.Array:
    """Returns False once the needle's simulation has diverged."""
    return pick.is_sound(bound.pick, qpos, qvel)


TEXT = TaskText(
    title="needle regrasp",
    done="took the tilted needle for driving",
    strict="held a third from its swage within 0.1 of its length, square to the "
    "jaws within 15 degrees, lifted by 20 mm for 2 s without slipping by more than 0.5 mm, in time",
    loose="the needle was lifted by 20 mm, however it was held",
    nearly="needle lifted, but held elsewhere, askew, with slip or not for 2 s",
    collided="pressed jaws, palm or shaft into the table",
    ground="the foam",
    goal="the needle must be lifted, held a third from its swage",
)


TASK = Task(
    name="needle_regrasp",
    mjcf="tasks/needle_regrasp/needle_regrasp.xml",
    slots=(Slot(workspace="board", p_world_ref=(0.0, 0.0, 0.15), tool="needle_driver"),),
    cameras=("camera", endoscope_camera.NAME),
    time_limit_s=30.0,
    settle_steps=pick.SETTLE_STEPS,
    fields=pick.TASK.fields,
    stages=STAGES,
    text=TEXT,
    expert_version=2,
    experts={"default": "starjax.addons.suture.needle_regrasp.expert:AGENT"},
    graspable=pick.TASK.graspable,
    bind=bind,
    sample=sample,
    tips=lambda bound, layout, p_trocars: layout.tip[None],
    place_objects=place_objects,
    measure=measure,
    status=status,
    state=state,
    relative=pick.relative,
    is_sound=is_sound,
    drive=drive,
    outline=pick.outline,
    endoscope=workspaces.BOARD_ENDOSCOPE,
)
