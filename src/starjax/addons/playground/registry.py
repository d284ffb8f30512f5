"""Tasks in MuJoCo Playground's own registry: `registry.load("StarjaxReach")`.

>>> playground_registry.register()
>>> env = mujoco_playground.registry.load("StarjaxReach", config_overrides={"trocar": "unseen"})

Playground must be installed; nothing else of starjax needs it.
"""

import dataclasses
import importlib
from typing import Any

from starjax.addons.playground import environment as playground
from starjax.core import errors
from starjax.envs import registration
from starjax.envs.settings import EnvSettings
from starjax.sim import registries
from starjax.sim.task import CONTROL_HZ

_OWN = ("task", "episode_length", "ctrl_dt")  # entries that are not settings


def name(task: str) -> str:
    """Returns Playground's name of a task: `StarjaxPegTransfer` of `peg_transfer`."""
    return f"Starjax{registration.words(task)}"


def register() -> list[str]:
    """Registers all tasks; returns their names. Environments count as Playground's `MjxEnv`.

    Raises:
      errors.UsageError: Playground is not installed.
    """
    try:
        package: Any = importlib.import_module("mujoco_playground")
        config: Any = importlib.import_module("ml_collections")
    except ImportError as error:
        hint = "pip install playground"
        expected = "MuJoCo Playground to be installed"
        raise errors.UsageError("playground_registry", expected, error, hint) from None
    package.MjxEnv.register(playground.Environment)
    names = []
    for task in registries.tasks.names():
        names.append(name(task))
        package.manipulation.register_environment(
            name(task), _make, lambda task=task: config.ConfigDict(_defaults(task))
        )
    return names


def _defaults(task: str) -> dict[str, Any]:
    """Returns a task's configuration: the settings and Playground's own entries."""
    values = dataclasses.asdict(EnvSettings(task=task))
    values.pop("max_episode_steps")
    steps = round(registries.tasks.get(task).time_limit_s * CONTROL_HZ)
    return values | {"episode_length": steps, "ctrl_dt": 1.0 / CONTROL_HZ}


def _make(config: Any, config_overrides: dict[str, Any] | None = None) -> playground.Environment:
    values = {**config.to_dict(), **(config_overrides or {})}
    steps = values["episode_length"]
    given = {key: value for key, value in values.items() if key not in _OWN}
    return playground.make(values["task"], **given, max_episode_steps=int(steps))
