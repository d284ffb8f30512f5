"""Gymnasium environment of one episode at a time: a batch of one."""

from typing import Any

import gymnasium
import jax
import numpy as np
from gymnasium.vector import AutoresetMode
from jax.typing import ArrayLike

from starjax.envs import vector


class TaskEnv(gymnasium.Env):
    """One episode of a task at a time.

    Attributes:
      episodes: its pure functions, see `mdp.Episodes`.
    """

    metadata = vector.METADATA

    def __init__(self, *, render_mode: str | None = None, **arguments: Any) -> None:
        """Makes the environment; the first reset compiles its program.

        Args:
          render_mode: `rgb_array` or None.
          arguments: see `settings.EnvSettings`.

        Raises:
          errors.UsageError: an argument is unknown or out of range.
        """
        self._lanes = vector.TaskVectorEnv(
            1, autoreset_mode=AutoresetMode.DISABLED, render_mode=render_mode, **arguments
        )
        self.render_mode = render_mode
        self.episodes = self._lanes.episodes
        self.action_space = self._lanes.single_action_space
        self.observation_space = self._lanes.single_observation_space

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Begins an episode: the first one of `seed`, or without it the next. It has no options."""
        vector.check_options(options)
        super().reset(seed=None if seed is None else vector.checked_seed(seed))
        observed, info = self._lanes.reset(seed=seed)
        return _only(observed), _numbers(info)

    def step(self, action: ArrayLike) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Advances one control step (1/30 s) towards `action` `[D]` in [-1, 1]."""
        observed, reward, terminated, truncated, info = self._lanes.step(np.asarray(action)[None])
        return (
            _only(observed),
            float(reward[0]),
            bool(terminated[0]),
            bool(truncated[0]),
            _numbers(info),
        )

    def render(self) -> np.ndarray | None:
        """Renders the first camera, `[h, w, 3]` uint8."""
        frames = self._lanes.render()
        return None if frames is None else frames[0]


def _only(observed: Any) -> Any:
    return jax.tree.map(lambda x: x[0], observed)


def _numbers(info: dict[str, np.ndarray]) -> dict[str, Any]:
    return {name: x[0].item() for name, x in info.items() if not name.startswith("_")}
