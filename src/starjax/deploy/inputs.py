"""Checks what a robot measured: mistakes are named, not planned on.

One arm's arrays have no arm axis. Those of A arms have it last: `[O, A]`, or `[B, O, A]` of B
robots.
"""

import functools
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax import core

from starjax import rcm, types
from starjax.errors import UsageError
from starjax.types import Pose

FARTHEST = 0.5  # m, of trocar or tip from the nominal one: farther are millimetres for metres
FARTHEST_OFF = 0.02  # m, of the trocar from the measured axis: farther is another trocar or frame
_WIDEST = 1.1  # of the gripper's [-1, 1], with what a sensor is off
_REAL = (jnp.floating, jnp.integer, jnp.bool_)
_SKEW = 0.05  # of R'R from the identity: what rounding and calibration leave is far below


@flax.struct.dataclass
class RobotObservation:
    """Measurements of one robot at the last O moments, oldest first; B robots' fields begin with B.

    Attributes:
      pose: of the tip in the world frame, `[O]`.
      gripper: opening of the jaws, `[O]` in [-1 closed, +1 open].
      image: `[O, h, w, 3]` uint8, of a policy's one camera.
      images: camera's name -> `[O, h, w, 3]` uint8, instead of `image`.
      state: the task's fields, `[O, S]`, of a policy that does not see.
    """

    pose: Any
    gripper: Any
    image: Any = None
    images: Any = None
    state: Any = None


class InputSpec(NamedTuple):
    """Shapes of the inputs of a policy.

    Attributes:
      moments: O.
      arms: `()` of one arm, `(A,)` of several: the axis that their arrays have.
      p_world_ref: `[*arms, 3]` m, nominal trocars.
      keeps_to_manifold: whether tools must pass through their trocars.
      image_size: pixels a side.
      cameras: whose images it looks at; empty: it looks at the state.
      state_size: S.
    """

    moments: int
    arms: tuple[int, ...]
    p_world_ref: np.ndarray
    keeps_to_manifold: bool
    image_size: int
    cameras: tuple[str, ...]
    state_size: int


def validate(
    spec: InputSpec, observation: Any, trocar: Any
) -> tuple[types.Observation, rcm.Trocar]:
    """Checked inputs as arrays, and the trocars `[*robots, *arms]`.

    Raises:
      UsageError: see `Deployed.__call__`.
    """
    if not isinstance(trocar, rcm.Trocar):
        raise UsageError("trocar", "an rcm.Trocar", type(trocar).__name__)
    trocar = rcm.check_trocar(trocar)
    farthest = 0.0 if is_traced(trocar.radius) else np.asarray(trocar.radius).max(initial=0.0)
    if farthest > FARTHEST:
        raise UsageError("trocar.radius", f"at most {FARTHEST} m", f"{farthest:g}")
    trocar = rcm.Trocar(*map(_array, trocar))  # within a program a traced one
    if not isinstance(observation, RobotObservation):
        raise UsageError("observation", "a deploy.Observation", type(observation).__name__)
    pose = (None, None) if observation.pose is None else observation.pose
    if not (isinstance(pose, tuple | list) and len(pose) == 2):
        raise UsageError("observation.pose", "a deploy.Pose", type(pose).__name__)
    seen = types.Observation(Pose(*map(_array, pose)), _array(observation.gripper))
    if spec.cameras:
        seen = seen._replace(images={name: _image(observation, name) for name in spec.cameras})
    else:
        seen = seen._replace(state=_array(observation.state))
    robots = _robots(spec, seen, trocar)
    _check_shapes(spec, seen, robots)
    trocar = rcm.Trocar(*(_broadcast(field, (*robots, *spec.arms)) for field in trocar))
    _check_values(spec, seen, trocar, len(robots))
    return seen, trocar


def _image(observation: RobotObservation, camera: str) -> Any:
    images = observation.images if observation.image is None else {camera: observation.image}
    return _array((images or {}).get(camera))


def _robots(spec: InputSpec, seen: types.Observation, trocar: rcm.Trocar) -> tuple[int, ...]:
    """`()` of one robot, `(B,)` of several."""
    shape = jnp.broadcast_shapes(*map(np.shape, trocar))
    one = list(spec.arms)
    try:
        whole = jnp.broadcast_shapes(shape, spec.arms)
    except ValueError:
        whole = None
    robots = None if whole is None else whole[: len(whole) - len(spec.arms)]
    if robots is None or len(robots) > 1 or robots == (0,):
        several = f"[{', '.join(['B', *map(str, one)])}]"
        raise UsageError("trocar", f"fields of shape {one} or {several}", list(shape))
    several = np.shape(seen.pose.p)[: -2 - len(spec.arms)]
    return robots or (several if len(several) == 1 else ())


def _check_shapes(spec: InputSpec, seen: types.Observation, robots: tuple[int, ...]) -> None:
    moments = (*robots, spec.moments)
    of_arms = (*moments, *spec.arms)
    expected: dict[str, tuple[Any, tuple[int, ...]]] = {
        "pose.R": (seen.pose.R, (*of_arms, 3, 3)),
        "pose.p": (seen.pose.p, (*of_arms, 3)),
        "gripper": (seen.gripper, of_arms),
    }
    images = {_image_field(spec, name): image for name, image in (seen.images or {}).items()}
    size = (*moments, spec.image_size, spec.image_size, 3)
    expected |= {name: (image, size) for name, image in images.items()}
    if not spec.cameras:
        expected["state"] = (seen.state, (*moments, spec.state_size))
    for name, (value, shape) in expected.items():
        if value is None or np.shape(value) != shape:
            got = "none" if value is None else list(np.shape(value))
            raise UsageError(f"observation.{name}", f"shape {list(shape)}", got)
        wanted, kinds = ("uint8", [jnp.uint8]) if name in images else ("real numbers", _REAL)
        if not any(jnp.issubdtype(value.dtype, kind) for kind in kinds):
            raise UsageError(f"observation.{name}", wanted, value.dtype)


def _image_field(spec: InputSpec, camera: str) -> str:
    return "image" if len(spec.cameras) == 1 else f"images[{camera!r}]"


def _check_values(
    spec: InputSpec, seen: types.Observation, trocar: rcm.Trocar, leading: int
) -> None:
    """Raises UsageError for what no robot measures: a policy would plan on from there."""
    found = {"pose.R": seen.pose.R, "pose.p": seen.pose.p, "gripper": seen.gripper}
    known = {
        name: np.asarray(value, np.float64)  # numpy's functions refuse or wrap some types
        for name, value in {**found, "state": seen.state}.items()
        if value is not None and not is_traced(value)
    }
    for name, value in known.items():
        if not np.isfinite(value).all():
            raise UsageError(f"observation.{name}", "finite numbers", "some that are not")
    if (R := known.get("pose.R")) is not None:
        off = np.abs(np.swapaxes(R, -1, -2) @ R - np.eye(3)).max()
        if off > _SKEW or (np.linalg.det(R) < 0).any():
            raise UsageError("observation.pose.R", "rotations", f"one off by {off:.2g}")
    if (p := known.get("pose.p")) is not None:
        far = np.linalg.norm(p - spec.p_world_ref, axis=-1).max()
        if far > FARTHEST:
            expected = f"tips within {FARTHEST} m of the nominal trocar {spec.p_world_ref.tolist()}"
            raise UsageError("observation.pose.p", expected, f"one {far:.3g} m away")
    if (gripper := known.get("gripper")) is not None and np.abs(gripper).max() > _WIDEST:
        worst = gripper.flat[np.abs(gripper).argmax()]
        expected = "numbers from -1 (closed) to 1 (open)"
        raise UsageError("observation.gripper", expected, f"{worst:.3g}")
    if spec.keeps_to_manifold and not any(map(is_traced, (*seen.pose, *trocar))):
        off, depth = map(float, _through(seen.pose, trocar, spec.p_world_ref, leading))
        if off > FARTHEST_OFF:
            got = f"an axis that misses it by {1e3 * off:.0f} mm"
            raise UsageError("observation.pose", "tools through the trocar", got)
        if depth <= 0.0:
            expected = "tips beyond the trocar along the tool's axis, which points out of the jaws"
            hint = "a quaternion w x y z read as x y z w turns a tool round"
            got = f"one {-1e3 * depth:.0f} mm before it"
            raise UsageError("observation.pose", expected, got, hint)


@functools.partial(jax.jit, static_argnums=3)
def _through(
    pose: Pose, trocar: rcm.Trocar, p_world_ref: Any, leading: int
) -> tuple[jax.Array, jax.Array]:
    """m, the largest distance of trocars `[*robots, *arms]` from the axes of tools `[*robots, O,
    *arms]`, and the least depth of a tip."""
    through = jnp.expand_dims(rcm.trocar_position(trocar, p_world_ref), leading)
    return jnp.max(rcm.rcm_error(pose, through)), jnp.min(rcm.insertion_depth(pose, through))


def _array(value: Any) -> Any:
    return value if value is None or isinstance(value, jax.Array) else np.asarray(value)


def _broadcast(value: Any, shape: tuple[int, ...]) -> Any:
    # On the host where it is there: each operation of jax costs as much as all checks.
    place = jnp if isinstance(value, jax.Array) else np
    return place.broadcast_to(value, shape)


def is_traced(value: Any) -> bool:
    return isinstance(value, core.Tracer)
