"""Endoscope tracking: a camera on a straight scope keeps a moving tip in view. Lengths in m.

The scope looks down through its trocar, so gravity cannot define the horizon: with the tip below
the trocar the image would have to spin. Up in the image is a horizontal direction, `UP`.
"""

from typing import TYPE_CHECKING, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from starjax.core import errors
from starjax.core.types import Pose
from starjax.sim import endoscope_camera
from starjax.sim.task import CONTROL_HZ, Capsules, Field, SimReadings, Slot, Task, TaskStatus
from starjax.tasks.endoscope_track import text

if TYPE_CHECKING:  # a robot loads tasks without the simulator
    import mujoco

CAMERA = "endoscope"
UP = (-1.0, 0.0, 0.0)
DISTANCE = 0.06  # distance of the target from the lens

# The target's path: two oscillations a coordinate, about a centre.
CENTRE = (0.0, 0.0, 0.022)
REACH = (0.032, 0.024, 0.012)
SHARES = (0.7, 0.3)
RATES = ((0.35, 0.6), (0.8, 1.2))  # rad/s, ranges

# Start of an episode: the lens looks at CENTRE from afar, with the target in the image.
START = 0.07  # distance of CENTRE from the lens
SPREAD = 0.003  # spread of the lens, each axis, at most

# Strict success: on target for SHARE of the control steps from FIRST to LAST.
OFF_CENTRE = 0.05  # part of the picture's side
TILT = float(np.deg2rad(3.0))
FAR = 0.2  # part of DISTANCE, either way
FIRST, LAST = round(2 * CONTROL_HZ), round(29 * CONTROL_HZ)
SHARE = 0.9
MAY_MISS = round((1.0 - SHARE) * (LAST - FIRST))

STAGES = ("out of the picture", "in the picture", "on target", "done")
MAX_AWAY = 0.3  # beyond it the simulation has diverged


@flax.struct.dataclass
class TrackLayout:
    """Draws at reset.

    Attributes:
      rate: `[2, 3]` rad/s and phase: `[2, 3]` rad of the target's oscillations.
      spread: `[3]` m, offset of the lens's start from the nominal one.
    """

    rate: jax.Array
    phase: jax.Array
    spread: jax.Array


@flax.struct.dataclass
class TrackMeasurements:
    """Measurements of one moment and history of the episode.

    Attributes:
      target: `[3]` m.
      velocity: `[3]` m/s of the target.
      camera: pose_world_camera: x to the right, y up, it looks along -z.
      off: distance of the target from the image's centre, in sides of the image; 9 behind the lens.
      tilt: rad, of the image from level.
      distance: m, of the target from the lens.
      on_target: all three are within the limits.
      step: int32, control steps since reset.
      missed: int32, counted control steps without `on_target`.
      unseen: the target has left the image.
    """

    target: jax.Array
    velocity: jax.Array
    camera: Pose
    off: jax.Array
    tilt: jax.Array
    distance: jax.Array
    on_target: jax.Array
    step: jax.Array
    missed: jax.Array
    unseen: jax.Array


class TrackBound(NamedTuple):
    """Ids and shapes in the compiled model.

    Attributes:
      target, dof, ctrl: `[3]` indices of the target's coordinates in qpos, qvel and ctrl.
      R_tip_camera, p_tip_camera: the camera in the tip's frame.
      half: tangent of half the field of view.
      rod: `[2, 3]` m, ends of the instrument's rod, from the target.
      radius: m, of the rod.
    """

    target: np.ndarray
    dof: np.ndarray
    ctrl: np.ndarray
    R_tip_camera: np.ndarray
    p_tip_camera: np.ndarray
    half: float
    rod: np.ndarray
    radius: float


def bind(m: "mujoco.MjModel") -> TrackBound:
    """Resolves the ids of the target, and the camera's pose on the tool.

    Raises:
      errors.UsageError: the tool has no camera.
    """
    if CAMERA not in [m.camera(i).name for i in range(m.ncam)]:
        raise errors.UsageError("tool", f"one with a camera {CAMERA}", "one without")
    camera, names = m.camera(CAMERA), [f"target_{axis}" for axis in "xyz"]
    tip = m.site(int(np.flatnonzero(m.site_bodyid == camera.bodyid[0])[0]))
    rod = m.geom("rod")
    R_tip, R_camera, R_rod = (_matrix(part.quat) for part in (tip, camera, rod))
    ends = rod.pos + np.array([[-1.0], [1.0]]) * rod.size[1] * R_rod[:, 2]
    return TrackBound(
        target=np.array([m.joint(name).qposadr[0] for name in names]),
        dof=np.array([m.joint(name).dofadr[0] for name in names]),
        ctrl=np.array([m.actuator(name).id for name in names]),
        R_tip_camera=np.array(R_tip.T @ R_camera, np.float32),
        p_tip_camera=np.array(R_tip.T @ (camera.pos - tip.pos), np.float32),
        half=float(np.tan(np.deg2rad(camera.fovy[0]) / 2)),
        rod=np.array(ends, np.float32),
        radius=float(rod.size[0]),
    )


def sample(bound: TrackBound, key: jax.Array) -> TrackLayout:
    """Draws the target's path and the lens's start."""
    key_rate, key_phase, key_spread = jax.random.split(key, 3)
    low, high = jnp.array(RATES).T
    rate = low[:, None] + (high - low)[:, None] * jax.random.uniform(key_rate, (2, 3))
    phase = jax.random.uniform(key_phase, (2, 3), maxval=2 * jnp.pi)
    spread = jax.random.uniform(key_spread, (3,), minval=-SPREAD, maxval=SPREAD)
    return TrackLayout(rate, phase, spread)


def looking_at(
    target: jax.Array, p_trocar: jax.Array, distance: jax.Array | float, R_tip_camera: jax.Array
) -> Pose:
    """Returns the tip's pose with the target in the middle of a level image at `distance` m.

    The view may lean from the shaft in the plane of the image's vertical, as with oblique optics.
    """
    lean = R_tip_camera[2, 1], -R_tip_camera[2, 2]  # sine and cosine of the optics' angle
    camera = endoscope_camera.looking_at(target, p_trocar, distance, UP, lean)
    return Pose(camera.R @ R_tip_camera.T, camera.p)


def tips(bound: TrackBound, layout: TrackLayout, p_trocars: jax.Array) -> jax.Array:
    """Returns the lens's start, `[1, 3]` m."""
    R_tip_camera = jnp.asarray(bound.R_tip_camera)
    start = looking_at(jnp.array(CENTRE), p_trocars[0], jnp.array(START), R_tip_camera)
    return start.p[None] + layout.spread


def path(layout: TrackLayout, time: jax.Array) -> jax.Array:
    """Returns the target's commanded position `[3]` m, `time` s after reset."""
    # A sum of sines of drawn rates and phases: smooth, and no two trials are alike.
    waves = jnp.array(SHARES) @ jnp.sin(layout.rate * time + layout.phase)
    return jnp.array(CENTRE) + jnp.array(REACH) * waves


def place_objects(bound: TrackBound, qpos: jax.Array, layout: TrackLayout) -> jax.Array:
    """Places the target at the start of its path."""
    return qpos.at[bound.target].set(path(layout, jnp.zeros(())))


def drive(bound: TrackBound, layout: TrackLayout, ctrl: jax.Array, time: jax.Array) -> jax.Array:
    """Moves the target along its path."""
    return ctrl.at[bound.ctrl].set(path(layout, time))


def measure(
    bound: TrackBound, layout: TrackLayout, readings: SimReadings, before: TrackMeasurements | None
) -> TrackMeasurements:
    """Measures the target in the image and counts the steps off target."""
    target, tip = readings.qpos[bound.target], jax.tree.map(lambda leaf: leaf[0], readings.pose)
    camera = Pose(tip.R @ bound.R_tip_camera, tip.p + tip.R @ bound.p_tip_camera)
    x, y, z = camera.R.T @ (target - camera.p)  # in the camera, which looks along -z
    depth = jnp.maximum(-z, 1e-6)
    aside = jnp.stack([x, y]) / (2.0 * bound.half * depth)  # in sides of the picture
    off = jnp.where(z < 0, jnp.linalg.norm(aside), 9.0)  # behind the lens: far off
    is_seen = (z < 0) & (jnp.max(jnp.abs(aside)) < 0.5)
    across, along = jnp.array(UP) @ camera.R[:, 0], jnp.array(UP) @ camera.R[:, 1]
    tilt = jnp.abs(jnp.arctan2(across, along))  # rad between the picture's up and the world's
    distance = jnp.linalg.norm(target - camera.p)
    is_near = jnp.abs(distance - DISTANCE) < FAR * DISTANCE
    on_target = (off < OFF_CENTRE) & (tilt < TILT) & is_near
    step, missed, unseen = jnp.array(-1, jnp.int32), jnp.zeros((), jnp.int32), jnp.zeros((), bool)
    if before is not None:  # reset measures twice, so the count starts at -1
        step = before.step + 1
        counts = step > FIRST
        missed, unseen = before.missed + (counts & ~on_target), before.unseen | (counts & ~is_seen)
    return TrackMeasurements(
        target=target,
        velocity=readings.qvel[bound.dof],
        camera=camera,
        off=off,
        tilt=tilt,
        distance=distance,
        on_target=on_target,
        step=step,
        missed=missed,
        unseen=unseen,
    )


def status(bound: TrackBound, layout: TrackLayout, measurements: TrackMeasurements) -> TaskStatus:
    """Tests strict success (on target for long enough) and loose (never out of the image)."""
    is_over = measurements.step >= LAST
    may_succeed = measurements.missed <= MAY_MISS
    success_now = is_over & may_succeed
    stage = (measurements.off < 0.5).astype(jnp.int32) + measurements.on_target
    stage = jnp.where(success_now, 3, stage).astype(jnp.int32)
    kept = (measurements.step - measurements.missed) / LAST  # share of the time on target
    fraction = jnp.where(
        measurements.on_target, jnp.clip(kept, 0.0, 1.0), jnp.exp(-measurements.off / OFF_CENTRE)
    )
    reward = jnp.where(success_now, 1.0, (stage + fraction) / len(STAGES))
    lost = measurements.unseen & ~may_succeed
    return TaskStatus(success_now, is_over & ~measurements.unseen, lost, stage, reward)


def obstacles(bound: TrackBound, layout: TrackLayout, measurements: TrackMeasurements) -> Capsules:
    """Returns the instrument."""
    start, end = measurements.target + jnp.asarray(bound.rod)
    return Capsules(start[None], end[None], jnp.array([bound.radius]))


def is_sound(bound: TrackBound, qpos: jax.Array, qvel: jax.Array) -> jax.Array:
    """Returns False once the target has left its path."""
    return jnp.max(jnp.abs(qpos[bound.target])) < MAX_AWAY


def _matrix(wxyz: np.ndarray) -> np.ndarray:
    import mujoco

    R = np.zeros(9)
    mujoco.mju_quat2Mat(R, wxyz)
    return R.reshape(3, 3)


TASK = Task(
    name="endoscope_track",
    mjcf="tasks/endoscope_track/endoscope_track.xml",
    slots=(Slot(workspace="tissue", p_world_ref=(0.0, 0.0, 0.18), tool="endoscope"),),
    cameras=(CAMERA, "camera"),
    time_limit_s=30.0,
    settle_steps=1,
    fields=(Field("target.p", 3, "point"),),
    stages=STAGES,
    text=text.TEXT,
    expert_version=2,
    experts={"default": "starjax.tasks.endoscope_track.expert:AGENT"},
    graspable=(),
    bind=bind,
    sample=sample,
    tips=tips,
    place_objects=place_objects,
    measure=measure,
    status=status,
    state=lambda bound, layout, measurements: measurements.target,
    relative=lambda state, tips: (state - tips[..., 0, :]) / DISTANCE,
    obstacles=obstacles,
    is_sound=is_sound,
    outline=text.outline,
    drive=drive,
    least_steps=LAST,
)
