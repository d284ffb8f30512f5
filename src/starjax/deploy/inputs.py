"""Inputs of a deployed policy: their shapes, and checks of measured values.

Arrays of one arm have no arm axis. Those of A arms have it last: `[O, A]`, or `[B, O, A]` of B
robots.
"""

import functools
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax import core
from jax.typing import ArrayLike

from starjax import rcm
from starjax.core import types
from starjax.core.errors import UsageError
from starjax.core.types import Pose
from starjax.deploy import guard
from starjax.deploy.guard import MAX_SKEW
from starjax.sim import trocar_region

FARTHEST = 0.5  # m, from the nominal trocar to a trocar or a tip: beyond, the unit is mm
MAX_BEND = 0.2  # rad beyond the limits of a wrist: the error of a measured trocar is less
_MAX_OPENING = 1.1  # opening of a gripper in [-1, 1]: the rest is the sensor's error
_REAL = (jnp.floating, jnp.integer, jnp.bool_)


@flax.struct.dataclass
class RobotObservation:
    """Measurements of one robot at the last O times, oldest first; B robots' fields begin with B.

    Public as `deploy.Observation`.

    Attributes:
      pose: of the tip in the world frame, `[O]`.
      gripper: opening of the jaws, `[O]` in [-1 closed, +1 open].
      image: `[O, h, w, 3]` uint8, of a policy's one camera.
      images: camera's name -> `[O, h, w, 3]` uint8, instead of `image`.
      state: the task's fields, `[O, S]`, of a policy without cameras.
      stamp, image_stamp: s, `[O]`, times of the oldest measurement and the oldest image, as
        `time.time()`; `Client` and `drive` refuse old ones.
      shaft: pose_world_shaft `[O]`, measured, of a tool with a wrist.
      p_world_trocar: `[O, 3]` m, measured now, for `Client` and `drive` to notice its motion.
    """

    pose: Any
    gripper: Any
    image: Any = None
    images: Any = None
    state: Any = None
    stamp: Any = None
    image_stamp: Any = None
    shaft: Any = None
    p_world_trocar: Any = None


class InputSpec(NamedTuple):
    """Shapes of a policy's inputs; the greeting of a server has these fields.

    Attributes:
      moments: O, the observation horizon.
      arms: `()` of one arm, `(A,)` of several: the arm axis of arrays.
      p_world_ref: `[*arms, 3]` m, nominal trocars.
      keeps_to_manifold: True if tools must pass through their trocars.
      image_size: height and width in pixels.
      cameras: names of the observed cameras; empty if the policy observes the state.
      state_size: S.
      regions: of each arm's trocar, see `trocar_region`; empty: any trocar.
      wrist: fields of the `rcm.Wrist` of all tools; empty: straight tools, or straight wrists.
    """

    moments: int
    arms: tuple[int, ...]
    p_world_ref: np.ndarray
    keeps_to_manifold: bool
    image_size: int
    cameras: tuple[str, ...]
    state_size: int
    regions: tuple[Any, ...] = ()
    wrist: tuple[float, ...] = ()

    @property
    def held_wrist(self) -> rcm.Wrist | None:
        """Returns the wrist that a policy commands, None for a straight one."""
        return rcm.Wrist(*self.wrist) if self.wrist else None


def validate(
    spec: InputSpec,
    observation: RobotObservation | types.Observation,
    trocar: rcm.Trocar | ArrayLike,
    max_off_trocar: float = guard.MAX_OFF_TROCAR,
) -> tuple[types.Observation, rcm.Trocar]:
    """Checks the inputs; returns them as arrays, with trocars `[*robots, *arms]`.

    Args:
      max_off_trocar: m, from a straight shaft or a measured one to its trocar.

    Raises:
      UsageError: see `Deployed.__call__`.
    """
    if not isinstance(trocar, rcm.Trocar):
        raise UsageError("trocar", "an rcm.Trocar", type(trocar).__name__)
    trocar = rcm.check_trocar(trocar)
    radius = 0.0 if is_traced(trocar.radius) else np.asarray(trocar.radius).max(initial=0.0)
    if radius > FARTHEST:
        raise UsageError("trocar.radius", f"at most {FARTHEST} m", f"{radius:g}")
    trocar = rcm.Trocar(*map(_array, trocar))
    if not isinstance(observation, RobotObservation):
        raise UsageError("observation", "a deploy.Observation", type(observation).__name__)
    pose = (None, None) if observation.pose is None else observation.pose
    if not (isinstance(pose, tuple | list) and len(pose) == 2):
        raise UsageError("observation.pose", "a deploy.Pose", type(pose).__name__)
    sensors = types.Observation(Pose(*map(_array, pose)), _array(observation.gripper))
    if spec.cameras:
        images = {name: _array(image_of(observation, name)) for name in spec.cameras}
        sensors = sensors._replace(images=images)
    else:
        sensors = sensors._replace(state=_array(observation.state))
    robots = _robots(spec, sensors, trocar)
    _check_shapes(spec, sensors, robots)
    trocar = rcm.Trocar(*(_broadcast(field, (*robots, *spec.arms)) for field in trocar))
    check_trocar(spec, trocar)
    _check_values(spec, sensors, trocar, len(robots), observation.shaft, max_off_trocar)
    return sensors, trocar


def check_trocar(spec: InputSpec, trocar: rcm.Trocar) -> None:
    """Raises UsageError for a trocar outside the region of the policy's task."""
    if spec.regions and not any(map(is_traced, trocar)):
        reference = np.reshape(spec.p_world_ref, (-1, 3))
        shape = np.shape(trocar.radius)
        arms = (*shape[: len(shape) - len(spec.arms)], len(reference))
        fields = (np.asarray(field).reshape(arms) for field in trocar)
        places = trocar_position(rcm.Trocar(*fields), reference)
        trocar_region.check(spec.regions, reference, places)


def trocar_position(trocar: rcm.Trocar, p_world_ref: np.ndarray) -> np.ndarray:
    """Returns trocars `[*robots, *arms, 3]` m on the host, as `rcm.trocar_position`."""
    radius, polar, azimuth = (np.asarray(field, np.float64) for field in trocar)
    across = radius * np.sin(polar)
    offset = [across * np.cos(azimuth), across * np.sin(azimuth), radius * np.cos(polar)]
    return p_world_ref + np.stack(np.broadcast_arrays(*offset), -1)


def image_of(observation: RobotObservation, camera: str) -> Any:
    """Returns the images of a camera, None if the observation lacks them."""
    images = observation.images if observation.image is None else {camera: observation.image}
    return (images or {}).get(camera)


def _robots(spec: InputSpec, sensors: types.Observation, trocar: rcm.Trocar) -> tuple[int, ...]:
    """Returns the leading axes: `()` of one robot, `(B,)` of several."""
    shape = jnp.broadcast_shapes(*map(np.shape, trocar))
    try:
        whole = jnp.broadcast_shapes(shape, spec.arms)
        robots = whole[: len(whole) - len(spec.arms)]
    except ValueError:
        robots = None
    if robots is None or len(robots) > 1 or robots == (0,):
        several = f"[{', '.join(['B', *map(str, spec.arms)])}]"
        expected = f"fields of shape {list(spec.arms)} or {several}"
        raise UsageError("trocar", expected, list(shape))
    leading = np.shape(sensors.pose.p)[: -2 - len(spec.arms)]
    return robots or (leading if len(leading) == 1 else ())


def _check_shapes(spec: InputSpec, sensors: types.Observation, robots: tuple[int, ...]) -> None:
    moments = (*robots, spec.moments)
    of_arms = (*moments, *spec.arms)
    size = (*moments, spec.image_size, spec.image_size, 3)
    rows: list[tuple[str, Any, tuple[int, ...]]] = [
        ("pose.R", sensors.pose.R, (*of_arms, 3, 3)),
        ("pose.p", sensors.pose.p, (*of_arms, 3)),
        ("gripper", sensors.gripper, of_arms),
    ]
    for name, image in (sensors.images or {}).items():
        rows.append(("image" if len(spec.cameras) == 1 else f"images[{name!r}]", image, size))
    if not spec.cameras:
        rows.append(("state", sensors.state, (*moments, spec.state_size)))
    for name, value, shape in rows:
        if value is None or np.shape(value) != shape:
            got = "none" if value is None else list(np.shape(value))
            raise UsageError(f"observation.{name}", f"shape {list(shape)}", got)
        is_image = name.startswith("image")
        expected, kinds = ("uint8", (jnp.uint8,)) if is_image else ("real numbers", _REAL)
        if not any(jnp.issubdtype(value.dtype, kind) for kind in kinds):
            raise UsageError(f"observation.{name}", expected, value.dtype)


def _check_values(
    spec: InputSpec,
    sensors: types.Observation,
    trocar: rcm.Trocar,
    leading: int,
    shaft: Pose | None,
    max_off_trocar: float,
) -> None:
    """Raises UsageError for values that no robot measures, and tools off their trocar."""
    pose = sensors.pose
    rows = {"pose.R": pose.R, "pose.p": pose.p, "gripper": sensors.gripper, "state": sensors.state}
    values = {
        name: np.asarray(value, np.float64)  # numpy's functions refuse or wrap some types
        for name, value in rows.items()
        if value is not None and not is_traced(value)
    }
    for name, value in values.items():
        if not np.isfinite(value).all():
            at = np.argwhere(~np.isfinite(value))[0].tolist()
            raise UsageError(f"observation.{name}", "finite values", f"NaN or inf at {at}")
    if (R := values.get("pose.R")) is not None:
        skew = np.abs(np.swapaxes(R, -1, -2) @ R - np.eye(3)).max()
        if skew > MAX_SKEW or (np.linalg.det(R) < 0).any():
            raise UsageError("observation.pose.R", "rotations", f"one off by {skew:.2g}")
    if (p := values.get("pose.p")) is not None:
        distance = np.linalg.norm(p - spec.p_world_ref, axis=-1).max()
        if distance > FARTHEST:
            expected = f"tips within {FARTHEST} m of the nominal trocar {spec.p_world_ref.tolist()}"
            raise UsageError("observation.pose.p", expected, f"one {distance:.3g} m away")
    if (gripper := values.get("gripper")) is not None and np.abs(gripper).max() > _MAX_OPENING:
        worst = gripper.flat[np.abs(gripper).argmax()]
        expected = "values from -1 (closed) to 1 (open)"
        raise UsageError("observation.gripper", expected, f"{worst:.3g}")
    if any(map(is_traced, (*pose, *trocar))):
        return
    if spec.held_wrist:
        bend = float(_bend(spec.held_wrist, pose, trocar, spec.p_world_ref, leading))
        if bend > MAX_BEND:
            expected = "tools through the trocar within the limits of the wrist"
            got = f"one that would bend it by {np.rad2deg(bend):.0f} degrees more"
            raise UsageError("observation.pose", expected, got)
        if shaft is not None and not any(map(is_traced, shaft)):
            place = np.expand_dims(trocar_position(trocar, spec.p_world_ref), leading)
            check_off(float(guard.off_trocar(shaft, place).max()), max_off_trocar)
    elif spec.keeps_to_manifold:
        off, depth = map(float, _through(pose, trocar, spec.p_world_ref, leading))
        check_off(off, max_off_trocar)
        if depth <= 0.0:
            expected = "tips beyond the trocar along the tool's axis, which points out of the jaws"
            hint = "a quaternion w x y z read as x y z w turns a tool round"
            got = f"one {-1e3 * depth:.0f} mm before it"
            raise UsageError("observation.pose", expected, got, hint)


def check_off(off: float, max_off_trocar: float) -> None:
    """Raises UsageError for a shaft `off` m from its trocar."""
    if not off <= max_off_trocar:
        expected = f"a shaft within max_off_trocar, {1e3 * max_off_trocar:.3g} mm, of the trocar"
        hint = "measure the trocar and the frames again"
        raise UsageError("observation.pose", expected, f"{1e3 * off:.3g} mm", hint)


@functools.partial(jax.jit, static_argnums=3)
def _through(
    pose: Pose, trocar: rcm.Trocar, p_world_ref: np.ndarray, leading: int
) -> tuple[jax.Array, jax.Array]:
    """Measures tools `[*robots, O, *arms]` against trocars `[*robots, *arms]`.

    Returns:
      m, the largest RCM error; m, the least depth of a tip.
    """
    p_world_trocar = jnp.expand_dims(rcm.trocar_position(trocar, p_world_ref), leading)
    errors = rcm.rcm_error(pose, p_world_trocar)
    return jnp.max(errors), jnp.min(rcm.insertion_depth(pose, p_world_trocar))


@functools.partial(jax.jit, static_argnums=(0, 4))
def _bend(
    wrist: rcm.Wrist, pose: Pose, trocar: rcm.Trocar, p_world_ref: np.ndarray, leading: int
) -> jax.Array:
    """Returns the largest angle (rad) beyond the limits of tools `[*robots, O, *arms]`."""
    p_world_trocar = jnp.expand_dims(rcm.trocar_position(trocar, p_world_ref), leading)
    angles = rcm.angles_through(wrist, pose, p_world_trocar)
    return jnp.max(jnp.abs(angles) - jnp.array([wrist.pitch, wrist.yaw]))


def _array(value: Any) -> Any:
    return value if value is None or isinstance(value, jax.Array) else np.asarray(value)


def _broadcast(value: Any, shape: tuple[int, ...]) -> Any:
    # numpy for host arrays: one operation of jax takes as long as all checks.
    return (jnp if isinstance(value, jax.Array) else np).broadcast_to(value, shape)


def is_traced(value: Any) -> bool:
    """Returns True for a tracer, whose value no check can read."""
    return isinstance(value, core.Tracer)
