"""Environment record, its parameters and its state."""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.core.types import Command, Observation, Pose
from starjax.sim.names import SceneNames
from starjax.sim.task import Task

if TYPE_CHECKING:  # readers of datasets need no simulator
    from starjax.sim import physics, render
    from starjax.sim.scene import Scene


class EnvParams(NamedTuple):
    """Parameters of an episode.

    Attributes:
      trocar: true trocars, fields `[A]`.
      measured_trocar: trocars as agents see them, fields `[A]`, or None for the true ones.
      cameras: poses `[C]` of the observed cameras in their bodies' frames, or None for those of the
        MJCF; cameras fixed in the world follow them only in an environment with moving cameras.
      levels: level of each disturbance by name, for a disturbed environment.
    """

    trocar: rcm.Trocar
    measured_trocar: rcm.Trocar | None = None
    cameras: Pose | None = None
    levels: Mapping[str, jax.typing.ArrayLike] | None = None


class ImageSource(NamedTuple):
    """Everything that the images of one moment are a function of.

    Attributes:
      qpos: `[Q]` coordinates, see `EnvState.coordinates`.
      p_world_trocar: `[A, 3]` m.
      layout: the task's draws at reset.
      cameras: poses `[C]` of the cameras in their bodies' frames.
      has_look: see `EnvState`.
    """

    qpos: jax.Array
    p_world_trocar: jax.Array
    layout: Any
    cameras: Pose
    has_look: jax.Array | None = None


@flax.struct.dataclass
class EnvState:
    """State of one episode. Arrays are `[]` unless stated; batches come from vmap.

    Attributes:
      physics: joint positions, velocities, warm start.
      q_target: `[J]` rad of each arm with its wrist, joint target of the last command.
      q_velocity: `[J]` rad/s of each arm, its velocity.
      velocity: `[A, 7]` of the reference poses, see `control`; `[A, 9]` in a scene with a wrist,
        see `wrist_motion`.
      correction: `[A, 3]` m, feedback correction of the tools' axes at their trocars.
      gripper_target: `[A]` in [-1, 1].
      trocar: true trocars, `[A]`.
      measured_trocar: trocars as agents see them, `[A]`.
      cameras: `[C]` poses in their bodies' frames.
      layout: the task's own draws at reset.
      measurements: the task's own measurements of this moment.
      step: int32, control steps taken.
      settled: int32, consecutive steps with `TaskStatus.success_now`.
      stage: int32, index of `Task.stages`.
      reward: in [0, 1].
      done: the episode is frozen: success, lost or invalid.
      success: strict success.
      loose: the task's looser test was met at some step.
      lost: the task cannot succeed any more.
      invalid: the simulation diverged or its contact solver did not converge (the last sound state
        is kept), or a trocar is not finite.
      collided: an arm, shaft or jaw overlapped something without modelled contact.
      rcm_error: `[A]` m, executed: distance of the trocar from the measured axis of the shaft.
      rcm_error_within: `[A]` m, its maximum over the physics steps of the last control step.
      ik_error: `[A]` m, residual of the inverse kinematics, rotations weighed; inf after an invalid
        command (not finite, or R not a rotation), during which the arm holds.
      solver_error: J, see `physics.StepResult`, of the last control step.
      touch: `[A]` bool, the jaws touch something graspable.
      pose: `[A]` measured tips in the world.
      gripper: `[A]` measured openings in [-1, 1].
      shaft: `[A]` measured shafts in the world, that of a straight tool at its tip; None in a scene
        without a wrist.
      wrist: `[A, 2]` rad, measured angles, zero for a straight tool; None as `shaft`.
      commanded_shaft: `[A]` shafts of the last command, the tip's pose for a straight tool; None as
        `shaft`.
      model: this episode's own fields of the MJX model, by name.
      wrapper_state: memories of wrappers of the environment, by name.
      endoscope: measured pose_world_camera of the endoscope, see `sim.endoscope_camera`; None for a
        scene without one.
      thread: `[N, 3]` m, points of the task's thread; None for a task without one.
      has_look: bool, True if the images have the look of a body cavity; None in an environment
        whose look does not vary.
    """

    physics: "physics.PhysicsState"
    q_target: tuple[jax.Array, ...]
    q_velocity: tuple[jax.Array, ...]
    velocity: jax.Array
    correction: jax.Array
    gripper_target: jax.Array
    trocar: rcm.TrocarFrame
    measured_trocar: rcm.TrocarFrame
    cameras: Pose
    layout: Any
    measurements: Any
    step: jax.Array
    settled: jax.Array
    stage: jax.Array
    reward: jax.Array
    done: jax.Array
    success: jax.Array
    loose: jax.Array
    lost: jax.Array
    invalid: jax.Array
    collided: jax.Array
    rcm_error: jax.Array
    rcm_error_within: jax.Array
    ik_error: jax.Array
    solver_error: jax.Array
    touch: jax.Array
    pose: Pose
    gripper: jax.Array
    shaft: Pose | None = None
    wrist: jax.Array | None = None
    commanded_shaft: Pose | None = None
    model: dict[str, jax.Array] = flax.struct.field(default_factory=dict)
    wrapper_state: dict[str, Any] = flax.struct.field(default_factory=dict)
    endoscope: Pose | None = None
    thread: jax.Array | None = None
    has_look: jax.Array | None = None

    @property
    def coordinates(self) -> jax.Array:
        """Generalised coordinates `[..., Q]`, then the thread's points `[..., 3 N]`, if any."""
        qpos = self.physics.qpos
        if self.thread is None:
            return qpos
        return jnp.concatenate([qpos, self.thread.reshape(*qpos.shape[:-1], -1)], axis=-1)


class Env(NamedTuple):
    """Simulation as pure functions of one episode.

    Attributes:
      reset: (key, EnvParams) -> EnvState.
      step: (EnvState, Command `[A]`) -> EnvState, one control period; the state of a done episode
        stays.
      observe: EnvState -> Observation `[A]`.
      camera: EnvState -> camera's name -> render.CameraImage, at the observation's size.
      draw: ImageSource -> the same, without a simulation.
      labels: EnvState -> name of `Task.labels` -> int32.
      scene: the static scene; task: its task; names: of its parts.
      p_world_ref: `[A, 3]` m, the nominal trocars.
      control_hz: commands per second.
    """

    reset: Callable[[jax.Array, EnvParams], EnvState]
    step: Callable[[EnvState, Command], EnvState]
    observe: Callable[[EnvState], Observation]
    camera: "Callable[[EnvState], dict[str, render.CameraImage]]"
    draw: "Callable[[ImageSource], dict[str, render.CameraImage]]"
    labels: Callable[[EnvState], dict[str, jax.Array]]
    scene: "Scene"
    task: Task
    names: SceneNames
    p_world_ref: np.ndarray
    control_hz: float
