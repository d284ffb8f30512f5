"""A trained policy in a program of one's own: what a robot measures in, its commands out.

>>> policy = deploy.load("compact")
>>> command = policy(jax.random.key(0), observation, trocar)
"""

import dataclasses
import numbers
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from starjax import config, errors, limits, methods, rcm, types
from starjax.deploy import approach, inputs
from starjax.deploy.inputs import RobotObservation
from starjax.learners import LEARNERS
from starjax.policies import packaged, policy_file
from starjax.policies import policy as policies
from starjax.rcm import arrays
from starjax.runtime import files
from starjax.sim import registries
from starjax.sim.names import SceneNames
from starjax.types import Command, Pose


@dataclasses.dataclass(frozen=True, eq=False)
class Deployed:
    """A policy that is ready to decide; calling it runs one compiled program.

    Attributes:
      method: its row of `methods.METHODS`, by name.
      settings: what it was trained with. It reads the last `obs_horizon` moments, in images of
        `image_size` pixels a side if `observation` is "image", and plans `horizon` control steps
        of 1/30 s, of which `execute` are carried out before it is asked again.
      scene: names of the task, arms, tools and cameras that it was trained with.
      p_world_ref: `[3]` m, the nominal trocar, which a trocar is described from; `[A, 3]` of A
        arms.
      max_first_move: m, how far from the measured tip a plan may begin.
      max_first_turn: rad, how far from the measured rotation.
      input_spec: shapes of its inputs.

    It pickles as the arguments that it was loaded with: another process loads the same file.
    """

    method: str
    settings: config.PolicyConfig
    scene: SceneNames
    p_world_ref: np.ndarray
    max_first_move: float
    max_first_turn: float
    input_spec: inputs.InputSpec = dataclasses.field(repr=False)
    _source: tuple[Any, ...] = dataclasses.field(repr=False)
    _decide: Callable[..., tuple[Command, approach.StartOffset]] = dataclasses.field(repr=False)
    _weights: tuple[Any, Any] = dataclasses.field(repr=False)

    @property
    def digest(self) -> str:
        """SHA-256 of its file."""
        return self._source[1]

    @arrays.broadcasting
    def __call__(
        self, key: jax.Array, observation: RobotObservation, trocar: rcm.Trocar
    ) -> Command:
        """Plans the next commands of one robot, or of B at once.

        The first call for a number of robots compiles the program. Arrays of a policy of several
        arms have one more axis, the last of their leading ones: `[O, A]`, `[H, A]`, trocars `[A]`.

        Args:
          key: random key; a new one for each decision. One robot uses it as it is, each of B its
            own part.
          observation: of the last O moments, oldest first, fields `[O, ...]` or `[B, O, ...]`.
          trocar: where the trocar is, fields `[]` or `[B]`, which broadcast; one for all robots if
            all are `[]`.

        Jaws are the same after half a turn, so a tool that is turned by more than a quarter (of
        `rcm.roll_of`), which no demonstration shows, is read and commanded as half a turn back.

        A tool that has just been passed through the trocar is shallower than any demonstrated one.
        Where a plan begins deeper and more than 3 mm or 0.15 rad from it, the commands are instead
        a slow approach (`approach.APPROACH_MOVE`, `APPROACH_TURN` per control step), which the next
        decisions continue. A tip less deep than `rcm.MIN_DEPTH` (5 mm) is sent there at once.

        Returns:
          Command `[H]` or `[B, H]`: tip poses in the world frame, all of them on the RCM manifold
          (but for `dp_ee`), and the gripper's openings.

        Raises:
          UsageError: an input is missing, has the wrong shape or type, is not finite or cannot have
            been measured: `R` is no rotation, or tip or trocar are farther than `FARTHEST` from
            the nominal trocar. For a policy on the RCM manifold also if the tool's axis passes the
            trocar by more than `FARTHEST_OFF`, or the tip is not beyond it. Also if the plan begins
            farther than `max_first_move` or `max_first_turn` from the measured pose.
            Values that jax traces are not checked: inside `jit` only shapes and types are.
        """
        _check_key(key)
        seen, trocar = inputs.validate(self.input_spec, observation, trocar)
        robots = np.shape(trocar.radius)[: np.ndim(trocar.radius) - len(self.input_spec.arms)]
        keys = jax.random.split(key, robots[0]) if robots else key[None]
        if not robots:
            seen, trocar = jax.tree.map(lambda x: jnp.asarray(x)[None], (seen, trocar))
        command, found = self.plan(keys, seen, trocar)
        self.check_first(found)
        return command if robots else jax.tree.map(lambda x: x[0], command)

    def plan(
        self, keys: jax.Array, seen: types.Observation, trocar: rcm.Trocar
    ) -> tuple[Command, approach.StartOffset]:
        """Plans for B robots, each with its own key, of arrays that `inputs.validate` has checked.

        Args:
          keys: `[B]`.
          seen: `[B, O, *arms]`.
          trocar: `[B, *arms]`.

        Returns:
          Command `[B, H, *arms]`; how far their first ones are, `[B, *arms]`, for `check_first`.
        """
        return self._decide(*self._weights, keys, seen, trocar)

    def __reduce__(self) -> tuple[Callable[..., "Deployed"], tuple[Any, ...]]:
        path, digest, settings = self._source
        bounds = {"max_first_move": self.max_first_move, "max_first_turn": self.max_first_turn}
        return _load_again, (path, digest, {**settings, **bounds})

    def check_first(self, found: approach.StartOffset) -> None:
        """Raises UsageError where a plan begins farther than the bounds from the measured pose."""
        if inputs.is_traced(found.move):
            return
        move, turn = (np.max(x) for x in jax.device_get(found))
        hint = "compare the frames of pose and trocar with the policy's, or load it with more"
        if not move <= self.max_first_move:  # NaN too
            expected = f"a plan that begins within {1e3 * self.max_first_move:g} mm of the tip"
            raise errors.UsageError("max_first_move", expected, f"{1e3 * move:.0f} mm", hint)
        if not turn <= self.max_first_turn:
            expected = f"a plan that begins within {self.max_first_turn:g} rad of the tool"
            raise errors.UsageError("max_first_turn", expected, f"{turn:.2g} rad", hint)


def _check_key(key: Any) -> None:
    if not isinstance(key, jax.Array | np.ndarray):
        got = type(key).__name__
    elif not _is_key(key):
        got = f"{key.dtype}{list(key.shape)}"
    else:
        return
    raise errors.UsageError("key", "a jax.random.key, one for all robots", got)


def _is_key(array: jax.Array | np.ndarray) -> bool:
    """Whether it is one key, typed or in jax's older form."""
    if jnp.issubdtype(array.dtype, jax.dtypes.prng_key):
        return array.ndim == 0
    old = jax.eval_shape(lambda: jax.random.key_data(jax.random.key(0)))
    return (array.dtype, array.shape) == (old.dtype, old.shape)


@arrays.broadcasting
def load(
    policy: str | Path,
    method: str | None = None,
    *,
    max_first_move: float = approach.MAX_FIRST_MOVE,
    max_first_turn: float = approach.MAX_FIRST_TURN,
    **options: Any,
) -> Deployed:
    """Loads a policy from its file.

    jax's settings stay as they are. Where a program has set others of random numbers
    (`jax_threefry_partitionable`, `jax_random_seed_offset`), its keys draw other noise.

    Args:
      policy: a policy.safetensors, or the name of one that ships with starjax, such as "compact".
      method: of several with the same weights the one to run: `dp_ee_proj` runs those of `dp_ee`.
        By default the one that trained them.
      max_first_move: m, how far from the measured tip a plan may begin; for the owner of a robot
        to choose. Infinity: as far as it likes.
      max_first_turn: rad, how far from the measured rotation.
      options: of the policy's learner that decisions are made with, those of its training unless
        given. Of diffusion: `ddim_steps`, denoising steps of a decision, of which fewer are faster,
        and `temperature`.

    Raises:
      ValueError: there is no such file, it is damaged or of another version, an option is unknown,
        it or a bound is out of range, `method` has other weights, or its task, a tool or its
        learner is not installed.
    """
    for name, bound in (("max_first_move", max_first_move), ("max_first_turn", max_first_turn)):
        if not (isinstance(bound, numbers.Real) and bound > 0):
            raise errors.UsageError(name, "a number above 0", repr(bound))
    path = packaged.find("policy", str(policy))
    trained = policy_file.load(path)
    if trained.p_world_ref is None:
        raise errors.UsageError("policy", "one that says its nominal trocar", path)
    if trained.policy.frame != "world":
        expected = "one that plans in the world's frame"
        raise errors.UsageError("policy", expected, path, "train it with --policy.frame world")
    settings = _with_options(trained.policy, options)
    errors.choice(f"{path}: method", trained.method, methods.METHODS)
    method = method or trained.method
    sharing = [name for name, row in methods.METHODS.items() if row.weights_of == trained.method]
    errors.choice("method", method, sharing)
    row = methods.METHODS[method]
    task = registries.tasks.get(trained.scene.task)
    made = policies.make(row, settings, task, cameras=trained.scene.cameras)
    params = made.prepare_for_inference(trained.params)
    places = np.asarray(trained.p_world_ref, np.float32)
    arms = () if len(places) == 1 else (len(places),)
    input_spec = inputs.InputSpec(
        moments=settings.obs_horizon,
        arms=arms,
        p_world_ref=places if arms else places[0],
        keeps_to_manifold=row.keeps_to_manifold,
        image_size=settings.image_size,
        cameras=trained.scene.cameras if settings.observation == "image" else (),
        state_size=task.state_size,
    )
    leads = row.action_space if input_spec.keeps_to_manifold else None
    decide = jax.jit(_decider(made.sample, trained, not arms, leads))
    weights = jax.device_put((params, trained.normalizer))
    bounds = {"max_first_move": float(max_first_move), "max_first_turn": float(max_first_turn)}
    again = {"method": method, **options}
    source = (str(path.absolute()), files.sha256(path), again)
    return Deployed(
        method=method,
        settings=settings,
        scene=trained.scene,
        p_world_ref=input_spec.p_world_ref,
        **bounds,
        input_spec=input_spec,
        _source=source,
        _decide=decide,
        _weights=weights,
    )


def _load_again(path: str, digest: str, settings: dict[str, Any]) -> Deployed:
    """`load` in another process, of the same file."""
    loaded = load(path, **settings)
    if loaded._source[1] != digest:
        raise errors.UsageError("policy", "the file as it was when the policy was pickled", path)
    return loaded


def _with_options(settings: config.PolicyConfig, options: dict[str, Any]) -> config.PolicyConfig:
    """The settings with these options of their learner; UsageError for others, or other values."""
    known = [field.name for field in dataclasses.fields(settings.options)]
    given = {}
    for name, value in options.items():
        errors.choice("option", name, known)
        given[name] = value.item() if isinstance(value, np.generic) else value
    changed = config.from_dict(config.PolicyConfig, {**config.as_json(settings), **given})
    limits.check(changed)
    LEARNERS.get(changed.learner).check(changed.options, changed)
    return changed


def _decider(
    sample: Callable[..., Command],
    trained: policy_file.Trained,
    is_one_arm: bool,
    leads: str | None,
) -> Callable[..., tuple[Command, approach.StartOffset]]:
    """`sample` of trocars, and of one arm's arrays without an arm axis; tools that look the same
    after half a turn are turned back by it where they are turned by more than a quarter.

    `leads` is the action space of a policy that keeps to the manifold, whose plans
    `approach.with_approach` begins at shallow tools; None for others.
    """
    p_world_ref = np.asarray(trained.p_world_ref, np.float32)
    roll_zero = np.asarray(trained.roll_zero, np.float32)
    tools = [registries.tools.get(name) for name in trained.scene.tools]
    is_symmetric = np.array([tool.is_symmetric for tool in tools])

    def decide(params, stats, keys, seen: types.Observation, trocar: rcm.Trocar):
        if is_one_arm:
            pose = Pose(seen.pose.R[..., None, :, :], seen.pose.p[..., None, :])
            seen = seen._replace(pose=pose, gripper=seen.gripper[..., None])
            trocar = rcm.Trocar(*(field[..., None] for field in trocar))
        now = rcm.roll_of(seen.pose.R[:, -1]) - roll_zero
        sign = jnp.where((jnp.cos(now) < 0.0) & is_symmetric, -1.0, 1.0)[:, None, :, None, None]
        half = jnp.concatenate([sign, sign, jnp.ones_like(sign)], axis=-1)  # of x, y and z
        seen = seen._replace(pose=seen.pose._replace(R=seen.pose.R * half))
        told = rcm.trocar_frame(trocar, p_world_ref, roll_zero)
        command = sample(params, stats, keys, seen, told)
        now = Pose(*(x[:, -1].astype(jnp.float32) for x in seen.pose))
        if leads:
            command = approach.with_approach(leads, stats, now, command, told)
        found = approach.start_offset(now, Pose(*(x[:, 0] for x in command.pose)))
        R, p, gripper = command.pose.R * half, command.pose.p, command.gripper
        if is_one_arm:
            R, p, gripper = R[..., 0, :, :], p[..., 0, :], gripper[..., 0]
        return Command(Pose(R, p), gripper), found

    return decide
