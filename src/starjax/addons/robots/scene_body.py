"""The body of a simulated arm in one of our scenes, with contact, stepped by our physics."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from starjax.addons.robots import crtk, kinematics, sim_arm
from starjax.core.errors import UsageError
from starjax.core.types import Command, Pose
from starjax.rcm.trocar import Trocar
from starjax.runtime.precompile import Program
from starjax.sim import env as sim_env
from starjax.sim.state import EnvState

PERIODS = round(sim_arm.RATE / sim_env.CONTROL_HZ)  # topics' periods in a control period


class SceneBody:
    """An `ArmBody` in a scene: control periods take the goal at their start, joints in between are
    interpolated.

    Attributes:
      env: environment of one arm. state: EnvState of the episode.
      pose_world_base: of the topics' base frame.
      is_success: True once the task's own strict success was reached.
    """

    def __init__(
        self,
        task: str,
        arm: str,
        instrument: str,
        *,
        cameras: tuple[str, ...] = (),
        image_size: int = 128,
        trocar: int = 0,
        seed: int = 0,
    ) -> None:
        """Begins an episode.

        Args:
          task: of one arm. arm, instrument: as of `kinematics.of`.
          cameras: of the task; none for its first one.
          image_size: pixels per side.
          trocar: index of the task's configurations.
          seed: of the objects' places.

        Raises:
          UsageError: a name is unknown, or the task has two arms.
        """
        tool = kinematics.TOOLS.get(instrument, instrument)
        self.env = env = sim_env.make(task, (arm,), (tool,), cameras=cameras, image_size=image_size)
        if env.task.arms != 1:
            raise UsageError("task", "a task of one arm", task)
        self.kinematics = kinematics.of(arm, instrument, task)
        self._bound = env.scene.arms[0]
        placed = Trocar(*(np.asarray(field[trocar]) for field in env.task.trocars))
        self._advance, self._look = Program(self._advanced), Program(self._seen)
        self.state = Program(env.reset)(jax.random.key(seed), sim_env.EnvParams(placed))
        self._pictures = jax.device_get(self._look(self.state))
        self.is_success, self.is_sound, self._steps = False, True, 0
        self.q = self._before = self._after = self._measured()
        self.gripper = self._opening = float(self.state.gripper[0])
        tip = crtk.pose_of_arrays(*(np.asarray(x[0], np.float64) for x in self.state.pose))
        self.pose_world_base = crtk.compose(tip, crtk.inverse(self.kinematics.tip_of(self.q)))
        p_world_trocar = np.asarray(self.state.trocar.p_world_trocar[0], np.float64)
        base_world = crtk.inverse(self.pose_world_base)
        there = crtk.compose(base_world, crtk.pose_of_arrays(np.eye(3), p_world_trocar))
        self.p_base_trocar = np.asarray(there.p)
        self._advance(self.state, self._command(self.q, self.gripper))  # compiles

    def hold(self) -> np.ndarray:
        """Returns the joints of the controller's reference, which bears the present load."""
        return np.asarray(self.state.q_target[0], np.float64)

    def step(self, goal: np.ndarray, gripper: float) -> None:
        """Interpolates; begins a control period every `PERIODS` calls."""
        part = self._steps % PERIODS
        if not part:
            self._before, self._after = self._after, self._period(goal, gripper)
        fraction = (part + 1) / PERIODS
        self.q = self._before + fraction * (self._after - self._before)
        self.gripper += (self._opening - self.gripper) / (PERIODS - part)
        self._steps += 1

    def images(self) -> dict[str, np.ndarray]:
        """Returns the images at the end of a control period."""
        return self._pictures if self._steps % PERIODS == 0 else {}

    def _period(self, goal: np.ndarray, gripper: float) -> np.ndarray:
        self.state, pictures = self._advance(self.state, self._command(goal, gripper))
        self._pictures = jax.device_get(pictures)
        self.is_success |= bool(self.state.success)
        self.is_sound = not bool(self.state.invalid)
        self._opening = float(self.state.gripper[0])
        return self._measured()

    def _command(self, goal: np.ndarray, gripper: float) -> Command:
        wrist = None
        if self.kinematics.wrist is not None:
            wrist = jnp.asarray(goal[None, self._bound.joints :], jnp.float32)
        pose = crtk.compose(self.pose_world_base, self.kinematics.tip_of(goal))
        pose = Pose(*(jnp.asarray(x[None], jnp.float32) for x in pose))
        return Command(pose, jnp.asarray([gripper], jnp.float32), wrist)

    def _measured(self) -> np.ndarray:
        return np.asarray(self.state.physics.qpos[self._bound.q], np.float64)

    def _advanced(self, state: EnvState, command: Command) -> Any:
        """Computes a control period, also after a success, and the images."""
        going = state.replace(done=jnp.zeros((), bool))
        after = self.env.step(going, command)
        return after, self._seen(after)

    def _seen(self, state: EnvState) -> dict[str, jax.Array]:
        return {name: image.rgb for name, image in self.env.camera(state).items()}
