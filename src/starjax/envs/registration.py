"""Registration of every task as a Gymnasium environment. Imports neither jax nor mjx."""

import re

from starjax.core import extras
from starjax.sim import registries

VERSION = 0


def name(task: str) -> str:
    """Returns Gymnasium's name of a task: `starjax/PegTransfer-v0` of `peg_transfer`."""
    return f"starjax/{words(task)}-v{VERSION}"


def words(task: str) -> str:
    """Returns a task's name in camel case: `PegTransfer` of `peg_transfer`."""
    return "".join(word[:1].upper() + word[1:] for word in re.split(r"[_\W]+", task))


def register() -> None:
    """Registers all tasks, including those of other packages, once.

    Raises:
      errors.UsageError: Gymnasium is not installed.
    """
    extras.require("starjax.envs", "gym")
    import gymnasium

    for task in registries.tasks.names():
        if name(task) not in gymnasium.registry:
            gymnasium.register(
                name(task),
                entry_point="starjax.envs.task_env:TaskEnv",
                vector_entry_point="starjax.envs.vector:TaskVectorEnv",
                kwargs={"task": task},
            )
