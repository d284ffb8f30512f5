"""Tasks with the columns of `starjax export`: for policies that were trained on an export.

>>> env = exported.ExportedVectorEnv(8, task="peg_transfer", trocar="unseen", observation="image")
>>> observed, _ = env.reset(seed=0)
>>> observed, *_ = env.step(actions)  # absolute poses: x y z, quaternion x y z w, gripper

Observations and actions are those of the exported files, in m in the world frame; a wrist follows
from the tip's pose through the measured trocar. Trials are those
of an evaluation: commands are executed as they are, without the ranges of `ranges.actions`.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from jax.typing import ArrayLike

from starjax import rcm
from starjax.core import errors
from starjax.core.types import Command, Pose
from starjax.data import pose_rows
from starjax.data.pose_rows import ACTIONS
from starjax.envs import batch, forked, mdp, settings, vector
from starjax.sim import wrists
from starjax.sim.state import EnvState
from starjax.sim.task import Task

_MATRIX = 13  # numbers of an arm in the compiled program: p, R, gripper
IMAGE = "pixels/"


class ExportedVectorEnv(vector.TaskVectorEnv):
    """N episodes of a task side by side; those that are over rest until the next reset.

    Observations are `agent_pos` `[N, 8 A]` (`observation.state` of the export), `trocar`
    `[N, 3 A]`, and `environment_state` `[N, S]` or `pixels`, a dict of `[N, h, w, 3]` uint8.
    """

    def __init__(
        self,
        num_envs: int = 1,
        *,
        actions: str = "pose",
        trocar_in_state: bool = False,
        **arguments: Any,
    ) -> None:
        """Makes the environments; the first reset compiles their program.

        Args:
          num_envs: N.
          actions: `pose`, rows of `pose_rows`, or `rcm4`: roll rad, x y z m, gripper.
          trocar_in_state: append the trocar to `agent_pos`.
          arguments: see `settings.EnvSettings`.

        Raises:
          errors.UsageError: an argument is unknown or out of range.
        """
        errors.choice("actions", actions, ACTIONS)
        self._actions, self._has_trocar = actions, trocar_in_state
        self._rows: np.ndarray | None = None
        super().__init__(num_envs, autoreset_mode=AutoresetMode.DISABLED, **arguments)
        observed, size = sizes(self.episodes.env.task, actions, trocar_in_state)
        self.single_action_space = spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self.single_observation_space = self._observation_space(observed)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Any, dict[str, Any]]:
        """Begins episodes, see `TaskVectorEnv.reset`."""
        mask = (options or {}).get("reset_mask")
        observed, info = super().reset(seed=seed, options=options)
        return self._columns(observed, mask), info

    def step(
        self, actions: ArrayLike
    ) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Advances every lane by one control step (1/30 s), to actions in the export's columns.

        Raises:
          errors.UsageError: actions of another shape, or not finite.
        """
        actions = np.asarray(actions)
        if actions.shape != self.action_space.shape:
            expected = str(list(self.action_space.shape or ()))
            raise errors.UsageError("actions", expected, list(actions.shape))
        if self._actions == "pose":
            p, R, gripper = pose_rows.unpack("actions", actions)
            parts = [p, R.reshape(*p.shape[:-1], 9), gripper[..., None]]
            actions = np.concatenate(parts, -1).reshape(len(actions), -1)
        observed, reward, terminated, truncated, info = super().step(actions)
        columns = self._columns(observed, np.zeros(self.num_envs, bool))
        return columns, reward, terminated, truncated, info

    def _programs(self, num_envs: int) -> batch.EpisodeBatch:
        forked.refuse()
        return batch.of_episodes(_episodes(self.settings, self._actions), num_envs)

    def _observation_space(self, observed: dict[str, int]) -> spaces.Dict:
        shapes: dict[str, Any] = {name: (size,) for name, size in observed.items()}
        images = {}
        for name, shape in self._batch.observed.items():
            if name.startswith(IMAGE):
                images[name.removeprefix(IMAGE)] = spaces.Box(0, 255, shape.shape, np.uint8)
            elif name == "environment_state":
                shapes[name] = shape.shape
        boxes = {n: spaces.Box(-np.inf, np.inf, shape, np.float32) for n, shape in shapes.items()}
        return spaces.Dict({**boxes, **({"pixels": spaces.Dict(images)} if images else {})})

    def _columns(self, observed: dict[str, np.ndarray], mask: np.ndarray | None) -> dict[str, Any]:
        """Returns the export's columns; lanes of the mask begin an episode, all if it is None."""
        rows = pose_rows.pack(observed["p"], observed["R"], observed["gripper"])
        if self._rows is not None and mask is not None:
            continued = pose_rows.without_flips(rows, self._rows)
            rows = np.where(mask[:, None], rows, continued)
        self._rows = rows
        trocar = observed["trocar"].reshape(self.num_envs, -1)
        state = [rows, trocar] if self._has_trocar else [rows]
        images = {
            name.removeprefix(IMAGE): array
            for name, array in observed.items()
            if name.startswith(IMAGE)
        }
        columns = {"agent_pos": np.concatenate(state, -1).astype(np.float32), "trocar": trocar}
        if "environment_state" in observed:
            columns["environment_state"] = observed["environment_state"]
        return columns | ({"pixels": images} if images else {})


def sizes(task: Task, actions: str, trocar_in_state: bool) -> tuple[dict[str, int], int]:
    """Returns the sizes of a task's observed vectors by name, and that of an action.

    Raises:
      errors.UsageError: the actions are unknown.
    """
    errors.choice("actions", actions, ACTIONS)
    state = pose_rows.COLUMNS + 3 * trocar_in_state
    return {"agent_pos": state * task.arms, "trocar": 3 * task.arms}, ACTIONS[actions] * task.arms


def _episodes(chosen: settings.EnvSettings, actions: str) -> mdp.Episodes:
    """Returns the task's episodes with unscaled poses as observations and commands."""
    made = mdp.make(chosen)
    env, arms = made.env, made.env.task.arms
    width = _MATRIX if actions == "pose" else ACTIONS[actions]

    def step(state: EnvState, action: jax.Array) -> Any:
        rows = action.reshape(arms, width)
        if actions == "rcm4":
            pose, _ = rcm.ACTION_SPACES["rcm4"].decode(rows[:, :-1], state.measured_trocar)
        else:
            pose = Pose(rows[:, 3:12].reshape(arms, 3, 3), rows[:, :3])
        is_over = mdp.is_terminated(state) | (state.step >= made.max_steps)
        command = Command(pose, jnp.clip(rows[:, -1], -1.0, 1.0))
        command = wrists.through(env.task, command, state.measured_trocar.p_world_trocar)
        return env.step(state.replace(done=is_over), command)

    def observe(state: EnvState) -> dict[str, jax.Array]:
        seen = env.observe(state)
        named = {"p": seen.pose.p, "R": seen.pose.R, "gripper": seen.gripper}
        named["trocar"] = state.measured_trocar.p_world_trocar
        if seen.images is None:
            return {**named, "environment_state": seen.state}
        return {**named, **{IMAGE + name: image for name, image in seen.images.items()}}

    return made._replace(step=step, observe=observe, action_size=arms * width)
