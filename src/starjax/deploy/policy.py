"""A trained policy in a program of one's own: what a robot measures in, its commands out.

>>> policy = deploy.load("compact")
>>> command = policy(jax.random.key(0), observation, trocar)
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import core

from starjax import config, errors, methods, rcm
from starjax.policies import features, packaged, policy_file
from starjax.policies import policy as policies
from starjax.rcm import arrays
from starjax.sim.types import Observation
from starjax.types import Command, Pose

__all__ = ["FARTHEST", "Command", "Deployed", "Observation", "Pose", "load"]

FARTHEST = 0.5  # m, of trocar or tip from the nominal port: farther are millimetres for metres
FARTHEST_OFF = 0.02  # m, of the trocar from the measured axis: farther is another port or frame
_WIDEST = 1.1  # of the gripper's [-1, 1], with what a sensor is off
_REAL = (jnp.floating, jnp.integer, jnp.bool_)
_SKEW = 0.05  # of R'R from the identity: what rounding and calibration leave is far below


@dataclasses.dataclass(frozen=True, eq=False)
class Deployed:
    """A policy that is ready to decide; calling it runs one compiled program.

    Attributes:
      method: its row of Table II, by name.
      settings: what it was trained with. It asks for the last `obs_horizon` moments, in pictures of
        `image_size` pixels a side if `observation` is "image", and plans `horizon` control steps
        of 1/30 s, of which `execute` are carried out before it is asked again.
      p_world_ref: `[3]` m, the nominal port, which a trocar is described from.
    """

    method: str
    settings: config.PolicyConfig
    p_world_ref: np.ndarray
    _sample: Callable[..., Command] = dataclasses.field(repr=False)
    _weights: tuple[Any, Any] = dataclasses.field(repr=False)

    @arrays.broadcasting
    def __call__(self, key: jax.Array, observation: Observation, trocar: rcm.Trocar) -> Command:
        """Plans the next commands of one robot, or of B at once.

        The first call for a number of robots compiles the program.

        Args:
          key: random key; a new one for each decision. One robot uses it as it is, each of B its
            own part.
          observation: of the last O moments, oldest first, fields `[O, ...]` or `[B, O, ...]`.
          trocar: where the port is, fields `[]` or `[B]`, which broadcast; one for all robots if
            all are `[]`.

        Jaws are the same after half a turn, so a tool that is turned by more than a quarter (of
        `rcm.roll_of`), which no demonstration shows, is read and commanded as half a turn back.

        Returns:
          Command `[H]` or `[B, H]`: tip poses in the world frame, all of them on the RCM manifold
          (but for `dp_ee`), and the gripper's openings.

        Raises:
          ValueError: an array is missing or has another shape or type than expected, a number is
            not finite or none that is measured so, a rotation is none, the trocar is none, tip or
            trocar are farther than `FARTHEST` from the nominal port, or, of a policy that keeps to
            the RCM manifold, the tool's axis is farther than `FARTHEST_OFF` from the trocar.
            Values that jax traces are not looked at, nor, within a program, whether the tool
            passes through the trocar.
        """
        if not isinstance(trocar, rcm.Trocar):
            raise ValueError(f"trocar: expected an rcm.Trocar, got {type(trocar).__name__}")
        trocar = rcm.check_trocar(trocar)
        farthest = 0.0 if _is_traced(trocar.radius) else np.asarray(trocar.radius).max(initial=0.0)
        if farthest > FARTHEST:
            raise ValueError(f"trocar.radius: expected at most {FARTHEST} m, got {farthest:g}")
        _check_key(key)
        if not isinstance(observation, Observation):
            raise ValueError(
                f"observation: expected a deploy.Observation, got {type(observation).__name__}"
            )
        observation = self._given(observation)
        trocar = rcm.Trocar(*jnp.broadcast_arrays(*map(jnp.asarray, trocar)))
        several = np.shape(observation.pose.p)[:-2]
        robots = np.shape(trocar.radius) or (several if len(several) == 1 else ())
        self._check(observation, robots)
        trocar = rcm.Trocar(*(jnp.broadcast_to(field, robots) for field in trocar))
        self._check_values(observation, trocar)
        keys = jax.random.split(key, robots[0]) if robots else key[None]
        if not robots:
            observation, trocar = jax.tree.map(
                lambda x: jnp.asarray(x)[None], (observation, trocar)
            )
        command = self._sample(*self._weights, keys, observation, trocar)
        return command if robots else jax.tree.map(lambda x: x[0], command)

    def _given(self, observation: Observation) -> Observation:
        """What the policy looks at, as arrays."""
        pose = (None, None) if observation.pose is None else observation.pose
        if not (isinstance(pose, tuple | list) and len(pose) == 2):
            got = type(pose).__name__
            raise ValueError(f"observation.pose: expected a deploy.Pose, got {got}")
        kind = self.settings.observation
        seen = {kind: _array(getattr(observation, kind))}
        pose = Pose(*map(_array, pose))
        return Observation(pose=pose, gripper=_array(observation.gripper), **seen)

    def _check(self, observation: Observation, robots: tuple[int, ...]) -> None:
        if len(robots) > 1 or robots == (0,):
            raise ValueError(f"trocar: expected fields of shape [] or [B], got {list(robots)}")
        size, moments = self.settings.image_size, (*robots, self.settings.obs_horizon)
        expected: dict[str, tuple[int, ...]] = {"pose.R": (3, 3), "pose.p": (3,), "gripper": ()}
        given: dict[str, Any] = dict(
            zip(expected, (*observation.pose, observation.gripper), strict=True)
        )
        if self.settings.observation == "image":
            expected["image"], given["image"] = (size, size, 3), observation.image
        else:
            expected["state"], given["state"] = (features.TASK_STATE,), observation.state
        for name, rest in expected.items():
            shape = [*moments, *rest]
            got = "none" if given[name] is None else list(np.shape(given[name]))
            if got != shape:
                raise ValueError(f"observation.{name}: expected shape {shape}, got {got}")
            wanted, kinds = ("uint8", [jnp.uint8]) if name == "image" else ("real numbers", _REAL)
            if not any(jnp.issubdtype(given[name].dtype, kind) for kind in kinds):
                raise ValueError(f"observation.{name}: expected {wanted}, got {given[name].dtype}")

    def _check_values(self, observation: Observation, trocar: rcm.Trocar) -> None:
        """Raises ValueError for what no robot measures: a policy would plan on from there."""
        given = {
            "pose.R": observation.pose.R,
            "pose.p": observation.pose.p,
            "gripper": observation.gripper,
            "state": observation.state,
        }
        known = {
            name: np.asarray(value, np.float64)  # numpy's functions refuse or wrap some types
            for name, value in given.items()
            if value is not None and not _is_traced(value)
        }
        for name, value in known.items():
            if not np.isfinite(value).all():
                raise ValueError(
                    f"observation.{name}: expected finite numbers, got some that are not"
                )
        if (R := known.get("pose.R")) is not None:
            off = np.abs(np.swapaxes(R, -1, -2) @ R - np.eye(3)).max()
            if off > _SKEW or (np.linalg.det(R) < 0).any():
                raise ValueError(
                    f"observation.pose.R: expected rotations, got one off by {off:.2g}"
                )
        if (p := known.get("pose.p")) is not None:
            far = np.linalg.norm(p - self.p_world_ref, axis=-1).max()
            if far > FARTHEST:
                raise ValueError(
                    f"observation.pose.p: expected tips within {FARTHEST} m of the nominal port "
                    f"{self.p_world_ref.tolist()}, got one {far:.3g} m away"
                )
        if (gripper := known.get("gripper")) is not None and np.abs(gripper).max() > _WIDEST:
            raise ValueError(
                "observation.gripper: expected numbers from -1 (closed) to 1 (open), "
                f"got {gripper.flat[np.abs(gripper).argmax()]:.3g}"
            )
        traced = map(_is_traced, (*observation.pose, *trocar))
        if self._keeps_to_manifold and not any(traced):
            off = float(_largest_miss(observation.pose, trocar, self.p_world_ref))
            if off > FARTHEST_OFF:
                raise ValueError(
                    "observation.pose: expected tools through the trocar, "
                    f"got an axis that misses it by {1e3 * off:.0f} mm"
                )

    @property
    def _keeps_to_manifold(self) -> bool:
        row = methods.METHODS[self.method]
        return row.projects or row.action_space != "se3"


@jax.jit
def _largest_miss(pose: Pose, trocar: rcm.Trocar, p_world_ref: Any) -> jax.Array:
    """m, of trocars `[...]` from the axes of tools `[..., O]`."""
    through = rcm.trocar_position(trocar, p_world_ref)
    return jnp.max(rcm.rcm_error(pose, through[..., None, :]))


def _array(value: Any) -> Any:
    return value if value is None or isinstance(value, jax.Array) else np.asarray(value)


def _check_key(key: Any) -> None:
    if not isinstance(key, jax.Array | np.ndarray):
        got = type(key).__name__
    elif not _is_key(key):
        got = f"{key.dtype}{list(key.shape)}"
    else:
        return
    raise ValueError(f"key: expected a jax.random.key, one for all robots, got {got}")


def _is_key(array: jax.Array | np.ndarray) -> bool:
    """Whether it is one key, typed or in jax's older form."""
    if jnp.issubdtype(array.dtype, jax.dtypes.prng_key):
        return array.ndim == 0
    old = jax.eval_shape(lambda: jax.random.key_data(jax.random.key(0)))
    return (array.dtype, array.shape) == (old.dtype, old.shape)


def _is_traced(value: Any) -> bool:
    return isinstance(value, core.Tracer)


def load(policy: str | Path, ddim_steps: int | None = None, method: str | None = None) -> Deployed:
    """A policy from its file.

    Args:
      policy: a policy.safetensors, or the name of one that ships with starjax, such as "compact".
      ddim_steps: denoising steps of a decision, those of its training's settings unless given:
        fewer are faster.
      method: of several with the same weights the one to run: `dp_ee_proj` runs those of `dp_ee`.
        By default the one that trained them.

    Raises:
      ValueError: there is no such file, it is damaged or of another version, `ddim_steps` is out
        of range, or `method` has other weights.
    """
    path = packaged.find("policy", str(policy))
    trained = policy_file.load(path)
    if trained.p_world_ref is None:
        raise ValueError(f"policy: expected one that says its nominal port, got {path}")
    settings = trained.policy
    if ddim_steps is not None:
        fewest, most = config.FEWEST_DDIM_STEPS, settings.diffusion_steps
        if not (isinstance(ddim_steps, int | np.integer) and fewest <= ddim_steps <= most):
            raise ValueError(
                f"ddim_steps: expected an integer from {fewest} to {most}, got {ddim_steps}"
            )
        settings = dataclasses.replace(settings, ddim_steps=ddim_steps)
    errors.choice(f"{path}: method", trained.method, methods.METHODS)
    method = method or trained.method
    sharing = [name for name, row in methods.METHODS.items() if row.weights_of == trained.method]
    errors.choice("method", method, sharing)
    row = methods.METHODS[method]
    port = np.asarray(trained.p_world_ref, np.float32)
    made = policies.make(row, settings, port, trained.train)
    params = policies.for_sampling(trained.params, settings.dtype)
    weights = jax.device_put((params, trained.normalizer))
    return Deployed(method, settings, port, jax.jit(_half_turned(made.sample)), weights)


def _half_turned(sample: Callable[..., Command]) -> Callable[..., Command]:
    """`sample`, with tools that are turned by more than a quarter half a turn back."""

    def decide(params, stats, keys, observation: Observation, trocar: rcm.Trocar) -> Command:
        now = rcm.roll_of(observation.pose.R[:, -1])
        sign = jnp.where(jnp.abs(now) > jnp.pi / 2, -1.0, 1.0)[:, None, None, None]
        half = jnp.concatenate([sign, sign, jnp.ones_like(sign)], axis=-1)  # of x, y and z
        pose = observation.pose._replace(R=observation.pose.R * half)
        command = sample(params, stats, keys, observation.replace(pose=pose), trocar)
        return command._replace(pose=command.pose._replace(R=command.pose.R * half))

    return decide
