"""Settings of an environment for reinforcement learning."""

import dataclasses
from typing import Any

import numpy as np

from starjax import rcm
from starjax.core import errors
from starjax.core.config import DEFAULT_TASK

CONTROLS = ("relative", "absolute")
REWARDS = ("dense", "sparse")
OBSERVATIONS = ("state", "image")
TROCARS = ("seen", "unseen", "all", "random")
Row = tuple[float, ...]
Chosen = str | int | rcm.Trocar | tuple[Row, ...]


@dataclasses.dataclass(frozen=True)
class EnvSettings:
    """Settings of an environment, the keyword arguments of `gymnasium.make`.

    Attributes:
      task: key of `registries.tasks`.
      arms, tools: keys of `registries.arms` and `registries.tools`: one per slot of the task, one
        for all slots, or none for the task's defaults.
      trocar: true trocars. `seen`, `unseen`, `all`: every episode draws one of the task's
        configurations; `random`: uniformly in the workspace's ranges (Eq. 19); a whole number:
        that configuration of the task; a position (x, y, z) in m, `[3]` or `[A, 3]`, or a
        `rcm.Trocar` with fields `[]` or `[A]`: this one.
      action_space: key of `rcm.ACTION_SPACES`; one for wrists keeps to the manifold. Empty for
        `rcm4`, and for `rcm6` in a task that needs a wrist.
      control: actions `relative` to the measured pose, or `absolute`, see `mdp`.
      reward: `dense` or `sparse`, see `mdp`.
      observation: `state` (numbers) or `image` (pixels, and numbers of the tool).
      image_size: side in pixels of the cameras' square images, rendered ones too.
      cameras: of the task; none for its first one.
      max_episode_steps: control steps after which an episode is truncated, if fewer than the task's
        time limit has.
    """

    task: str = DEFAULT_TASK
    arms: tuple[str, ...] = ()
    tools: tuple[str, ...] = ()
    trocar: Chosen = "seen"
    action_space: str = ""
    control: str = "relative"
    reward: str = "dense"
    observation: str = "state"
    image_size: int = 96
    cameras: tuple[str, ...] = ()
    max_episode_steps: int | None = None


def make(**arguments: Any) -> EnvSettings:
    """Validates a user's settings.

    Raises:
      errors.UsageError: an unknown name, or a value out of range.
    """
    known = [field.name for field in dataclasses.fields(EnvSettings)]
    for name in arguments:
        errors.choice("environment's argument", name, known)
    for name in ("arms", "tools", "cameras"):
        if name in arguments:
            parts = arguments[name]
            arguments[name] = (parts,) if isinstance(parts, str) else tuple(parts)
    if "trocar" in arguments:
        arguments["trocar"] = _trocar(arguments["trocar"])
    settings = EnvSettings(**arguments)
    if settings.action_space:
        errors.choice("action_space", settings.action_space, rcm.ACTION_SPACES)
    errors.choice("control", settings.control, CONTROLS)
    errors.choice("reward", settings.reward, REWARDS)
    errors.choice("observation", settings.observation, OBSERVATIONS)
    steps = settings.max_episode_steps
    if steps is not None and steps < 1:
        raise errors.UsageError("max_episode_steps", "1 or more", steps)
    return settings


def _trocar(choice: Any) -> Chosen:
    """Returns a hashable choice: parameters as a Trocar of tuples, positions as rows."""
    if isinstance(choice, str):
        errors.choice("trocar", choice, TROCARS)
        return choice
    if isinstance(choice, int | np.integer):
        return int(choice)
    try:
        if isinstance(choice, rcm.Trocar):
            rows = np.broadcast_arrays(*(np.atleast_1d(np.asarray(x, float)) for x in choice))
            return rcm.check_trocar(rcm.Trocar(*(tuple(row.tolist()) for row in rows)))
        places = np.atleast_2d(np.asarray(choice, float))
        if places.ndim != 2 or places.shape[1] != 3:
            raise ValueError(f"positions of shape {list(places.shape)}")
        return tuple(tuple(row) for row in places.tolist())
    except (TypeError, ValueError) as error:
        expected = f"{', '.join(TROCARS)}, a number, (x, y, z) in m, or an rcm.Trocar"
        raise errors.UsageError("trocar", expected, repr(choice), str(error)) from error
