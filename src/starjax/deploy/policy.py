"""A trained policy in the caller's process: measurements in, commands out.

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

from starjax import rcm
from starjax.core import config, errors, methods, types
from starjax.core.types import Command, Pose
from starjax.data import normalizer
from starjax.deploy import approach, guard, inputs, random_keys
from starjax.deploy.inputs import RobotObservation
from starjax.policies import packaged, policy_file, sampling
from starjax.policies import policy as policies
from starjax.policies.monitor.record import Monitor
from starjax.rcm import arrays
from starjax.runtime import files, precompile
from starjax.sim import registries, trocar_region, wrists
from starjax.sim.names import SceneNames

_BOUNDS = ("max_first_move", "max_first_turn", "max_off_trocar")


@dataclasses.dataclass(frozen=True, eq=False)
class Deployed:
    """A policy ready for inference; a call runs one compiled program.

    Attributes:
      method: key of `methods.METHODS`.
      settings: of its training. The policy observes the last `obs_horizon` times, in images of
        `image_size` pixels squared if `observation` is "image", and plans `horizon` control steps
        of 1/30 s; the caller executes the first `execute` of them and calls it again.
      scene: names of the task, arms, tools and cameras of its training.
      p_world_ref: `[3]` m, the nominal trocar, origin of trocar parameters; `[A, 3]` of A arms.
      max_first_move: m, maximum distance from the measured tip to a plan's first tip.
      max_first_turn: rad, the same of the rotation.
      max_off_trocar: m, maximum distance from the measured shaft to the trocar.
      input_spec: shapes of the inputs.
      monitor: runtime monitor of the file, None without one or if other options or another method
        change the plans; `monitor.watch.Watch` runs it.

    It pickles as the arguments of `load`: another process loads the same file.
    """

    method: str
    settings: config.PolicyConfig
    scene: SceneNames
    p_world_ref: np.ndarray
    max_first_move: float
    max_first_turn: float
    max_off_trocar: float
    input_spec: inputs.InputSpec = dataclasses.field(repr=False)
    _source: tuple[Any, ...] = dataclasses.field(repr=False)
    _infer: Callable[..., tuple[Command, approach.StartOffset]] = dataclasses.field(repr=False)
    _weights: tuple[Any, Any] = dataclasses.field(repr=False)
    monitor: Monitor | None = dataclasses.field(default=None, repr=False)

    @property
    def digest(self) -> str:
        """Returns the SHA-256 of its file."""
        return self._source[1]

    @arrays.broadcasting
    def __call__(
        self, key: jax.Array, observation: RobotObservation, trocar: rcm.Trocar
    ) -> Command:
        """Plans the next commands of one robot, or of B at once.

        The first call for a number of robots compiles the program. Arrays of a policy of several
        arms have one more axis, the last of their leading ones: `[O, A]`, `[H, A]`, trocars `[A]`.

        Args:
          key: random key, different for every call. One robot uses it unchanged; B robots split it.
          observation: of the last O times, oldest first, fields `[O, ...]` or `[B, O, ...]`.
          trocar: measured trocar, fields `[]` or `[B]`, which broadcast; all `[]` is one trocar for
            all robots.

        Jaws look the same after half a turn. A tool with a roll (`rcm.roll_of`) of more than a
        quarter turn, which no demonstration has, is observed and commanded half a turn back.

        A tool that has just been passed through the trocar is shallower than any demonstrated one.
        If a plan begins deeper and more than 3 mm or 0.15 rad from it, the commands are instead a
        slow approach (`approach.APPROACH_MOVE`, `APPROACH_TURN` per control step), which the next
        calls continue. A tip above `rcm.MIN_DEPTH` (5 mm) first jumps to that depth.

        Returns:
          Command `[H]` or `[B, H]`: tip poses in the world frame, on the RCM manifold except for
          `dp_ee`, the gripper's openings, and the angles of a wrist that the policy moves.

        Raises:
          UsageError: an input is missing, has the wrong shape or type, is not finite or cannot have
            been measured: `R` is not a rotation, the tip is farther than `FARTHEST` from the
            nominal trocar, or the trocar farther than `trocar_region.OUTSIDE` from the task's
            workspace. For a policy on the RCM manifold also if the shaft passes the trocar by more
            than `max_off_trocar`, or the tip is not beyond it. Also if the plan begins farther than
            `max_first_move` or `max_first_turn` from the tool. Inside `jit` only shapes and types
            are checked.
        """
        random_keys.check(key)
        sensors, trocar = inputs.validate(self.input_spec, observation, trocar, self.max_off_trocar)
        robots = np.shape(trocar.radius)[: np.ndim(trocar.radius) - len(self.input_spec.arms)]
        keys = jax.random.split(key, robots[0]) if robots else key[None]
        if not robots:
            sensors, trocar = jax.tree.map(lambda x: jnp.asarray(x)[None], (sensors, trocar))
        command, offset = self.plan(keys, sensors, trocar)
        self.check_first(offset)
        return command if robots else jax.tree.map(lambda x: x[0], command)

    def plan(
        self, keys: jax.Array, sensors: types.Observation, trocar: rcm.Trocar
    ) -> tuple[Command, approach.StartOffset]:
        """Plans for B robots, from arrays that `inputs.validate` has checked.

        Args:
          keys: `[B]`, one per robot.
          sensors: `[B, O, *arms]`.
          trocar: `[B, *arms]`.

        Returns:
          Command `[B, H, *arms]`; offsets of the first ones `[B, *arms]`, for `check_first`.
        """
        return self._infer(*self._weights, keys, sensors, trocar)

    def __reduce__(self) -> tuple[Callable[..., "Deployed"], tuple[Any, ...]]:
        path, digest, settings = self._source
        bounds = {name: getattr(self, name) for name in _BOUNDS}
        return _load_again, (path, digest, {**settings, **bounds})

    def check_first(self, offset: approach.StartOffset) -> None:
        """Raises UsageError if a plan begins farther than the bounds from the measured pose."""
        if inputs.is_traced(offset.move):
            return
        move, turn = (np.max(x) for x in jax.device_get(offset))
        hint = (
            "compare the frames of the pose and the trocar with the policy's, or load it with more"
        )
        if not move <= self.max_first_move:  # NaN too
            expected = f"a plan that begins within {1e3 * self.max_first_move:g} mm of the tip"
            raise errors.UsageError("max_first_move", expected, f"{1e3 * move:.0f} mm", hint)
        if not turn <= self.max_first_turn:
            expected = f"a plan that begins within {self.max_first_turn:g} rad of the tool"
            raise errors.UsageError("max_first_turn", expected, f"{turn:.2g} rad", hint)


@arrays.broadcasting
def load(
    policy: str | Path,
    method: str | None = None,
    *,
    max_first_move: float = approach.MAX_FIRST_MOVE,
    max_first_turn: float = approach.MAX_FIRST_TURN,
    max_off_trocar: float = guard.MAX_OFF_TROCAR,
    **options: Any,
) -> Deployed:
    """Loads a policy from its file.

    jax's settings stay unchanged. If a program has set others for random numbers
    (`jax_threefry_partitionable`, `jax_random_seed_offset`), its keys draw other noise.

    Args:
      policy: a policy.safetensors, or the name of a packaged policy such as "compact".
      method: the one to run of several with the same weights: `dp_ee_proj` runs those of `dp_ee`.
        Default: the method of the training.
      max_first_move: m, maximum distance from the measured tip to a plan's first tip; for the owner
        of a robot to choose. Infinity disables the check.
      max_first_turn: rad, the same of the rotation.
      max_off_trocar: m, maximum distance from the measured shaft to the trocar: the first command
        moves the shaft as far in the wall.
      options: of the policy's learner at inference; default: those of the training. For diffusion
        `ddim_steps`, the number of denoising steps, and `temperature`.

    Raises:
      ValueError: the file is missing, damaged or of another version; an option is unknown; it or a
        bound is out of range; `method` has other weights; or the task, a tool or the learner is not
        installed.
    """
    for name, bound in zip(_BOUNDS, (max_first_move, max_first_turn, max_off_trocar), strict=True):
        if not (isinstance(bound, numbers.Real) and bound > 0):
            raise errors.UsageError(name, "a number above 0", repr(bound))
    path = packaged.find("policy", str(policy))
    trained = policy_file.load(path)
    if trained.p_world_ref is None:
        raise errors.UsageError("policy", "one with its nominal trocar", path)
    settings = sampling.changed(trained.policy, options)
    errors.choice(f"{path}: method", trained.method, methods.METHODS)
    method = method or trained.method
    sharing = [name for name, row in methods.METHODS.items() if row.weights_of == trained.method]
    errors.choice("method", method, sharing)
    row = methods.METHODS[method]
    task = wrists.holding(registries.tasks.get(trained.scene.task), trained.scene)
    wrist = normalizer.wrist_of(row, task)
    keeps = normalizer.keeps_to_manifold(row)
    if wrist is not None and not keeps:
        expected = "one whose shaft passes the trocar"
        others = [name for name in sharing if methods.METHODS[name].projects]
        hint = f"{', '.join(others)} has these weights" if others else ""
        raise errors.UsageError("method", expected, method, hint)
    made = policies.make(row, settings, task, cameras=trained.scene.cameras)
    params = made.prepare_for_inference(trained.params)
    p_world_ref = np.asarray(trained.p_world_ref, np.float32)
    arms = () if len(p_world_ref) == 1 else (len(p_world_ref),)
    input_spec = inputs.InputSpec(
        moments=settings.obs_horizon,
        arms=arms,
        p_world_ref=p_world_ref if arms else p_world_ref[0],
        keeps_to_manifold=keeps,
        image_size=settings.image_size,
        cameras=trained.scene.cameras if settings.observation == "image" else (),
        state_size=task.state_size,
        regions=trocar_region.of_task(task),
        wrist=() if wrist is None else tuple(wrist),
    )
    approach_space = row.action_space if keeps and wrist is None else None
    infer = _inference(made.sample, trained, p_world_ref, not arms, approach_space, wrist)
    return Deployed(
        method=method,
        settings=settings,
        scene=trained.scene,
        p_world_ref=input_spec.p_world_ref,
        max_first_move=float(max_first_move),
        max_first_turn=float(max_first_turn),
        max_off_trocar=float(max_off_trocar),
        input_spec=input_spec,
        _source=(str(path.absolute()), files.sha256(path), {"method": method, **options}),
        _infer=precompile.Program(infer),
        _weights=jax.device_put((params, trained.normalizer)),
        monitor=None if options or method != trained.method else trained.monitor,
    )


def _load_again(path: str, digest: str, settings: dict[str, Any]) -> Deployed:
    """Loads the same file in another process."""
    loaded = load(path, **settings)
    if loaded._source[1] != digest:
        raise errors.UsageError("policy", "the file as it was when the policy was pickled", path)
    return loaded


def _inference(
    sample: Callable[..., Command],
    trained: policy_file.Trained,
    p_world_ref: np.ndarray,
    is_one_arm: bool,
    approach_space: str | None,
    wrist: rcm.Wrist | None,
) -> Callable[..., tuple[Command, approach.StartOffset]]:
    """Wraps `sample` for measured inputs: arm axis, trocar frames, half turns, slow approach.

    `approach_space` is the action space of a policy on the manifold, whose plans get
    `approach.with_approach`; None for others. With a `wrist` half a turn is one of the shaft, with
    both angles negated.
    """
    roll_zero = np.asarray(trained.roll_zero, np.float32)
    tools = [registries.tools.get(name) for name in trained.scene.tools]
    is_symmetric = np.array([tool.is_symmetric for tool in tools])

    def infer(params, stats, keys, sensors: types.Observation, trocar: rcm.Trocar):
        if is_one_arm:
            pose = Pose(sensors.pose.R[..., None, :, :], sensors.pose.p[..., None, :])
            sensors = sensors._replace(pose=pose, gripper=sensors.gripper[..., None])
            trocar = rcm.Trocar(*(field[..., None] for field in trocar))
        frame = rcm.trocar_frame(trocar, p_world_ref, roll_zero)
        # Half a turn about the tool's z axis negates the x and y columns of R.
        shaft = Pose(sensors.pose.R[:, -1], sensors.pose.p[:, -1])
        if wrist is not None:
            angles = rcm.angles_through(wrist, shaft, frame.p_world_trocar)
            shaft = rcm.shaft_of(wrist, shaft, angles)
        roll = rcm.roll_of(shaft.R) - roll_zero
        sign = jnp.where((jnp.cos(roll) < 0.0) & is_symmetric, -1.0, 1.0)[:, None, :, None, None]
        half_turn = jnp.concatenate([sign, sign, jnp.ones_like(sign)], axis=-1)
        sensors = sensors._replace(pose=sensors.pose._replace(R=sensors.pose.R * half_turn))
        command = sample(params, stats, keys, sensors, frame)
        measured = Pose(*(x[:, -1].astype(jnp.float32) for x in sensors.pose))
        if approach_space:
            command = approach.with_approach(approach_space, stats, measured, command, frame)
        offset = approach.start_offset(measured, Pose(*(x[:, 0] for x in command.pose)))
        R, p, gripper = command.pose.R * half_turn, command.pose.p, command.gripper
        angles = None if command.wrist is None else command.wrist * sign[..., 0]
        if is_one_arm:
            R, p, gripper = R[..., 0, :, :], p[..., 0, :], gripper[..., 0]
            angles = None if angles is None else angles[..., 0, :]
        return Command(Pose(R, p), gripper, angles), offset

    return infer
