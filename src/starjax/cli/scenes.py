"""Scenes of runs: missing names become those of the task."""

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from starjax.core import config as config_lib
from starjax.core import errors, methods
from starjax.sim.names import SceneNames

if TYPE_CHECKING:  # for annotations alone
    from starjax.sim.state import Env


def settings(names: SceneNames) -> config_lib.SceneConfig:
    """Returns the settings of a scene with all names."""
    return config_lib.SceneConfig(
        task=names.task, arm=names.arms, tool=names.tools, camera=names.cameras
    )


def names(scene: config_lib.SceneConfig) -> SceneNames:
    """Returns the names of a scene whose settings are complete, see `resolved`."""
    return SceneNames(scene.task, scene.arm, scene.tool, scene.camera)


def disturbable(env: "Env", disturbances: Sequence[str], policy: config_lib.PolicyConfig) -> Any:
    """Returns the environment, with cameras that move and a look that varies as they must."""
    from starjax.evaluation.disturbances import DISTURBANCES
    from starjax.sim import env as sim_env

    kinds = [DISTURBANCES.get(name) for name in disturbances]
    if not any(kind.redraws for kind in kinds):
        return env
    varying_look = any(kind.on_look for kind in kinds)
    return sim_env.for_policy(env.names, policy, moving_cameras=True, varying_look=varying_look)


def resolved(config: config_lib.RunConfig) -> config_lib.RunConfig:
    """Returns settings with all names of the scene and a number of trocars that its task has.

    Raises:
      errors.UsageError: a name is unknown, or the task has fewer seen trocars.
    """
    # Imported here because it imports jax and MuJoCo.
    from starjax.sim import registries, scene

    scene_config, demos = config.scene, config.demos
    full = scene.name(scene_config.task, scene_config.arm, scene_config.tool, scene_config.camera)
    task = registries.tasks.get(full.task)
    most = int(task.is_seen.sum())
    is_default = demos.seen_trocars == config_lib.DemosConfig().seen_trocars
    if demos.seen_trocars > most and not is_default:  # the default is all of them
        raise errors.UsageError("demos.seen_trocars", f"1 to {most}", demos.seen_trocars)
    seen = min(demos.seen_trocars, most)
    return dataclasses.replace(
        config, scene=settings(full), demos=dataclasses.replace(demos, seen_trocars=seen)
    )


def check_wrists(scene: config_lib.SceneConfig, selected: Sequence[str]) -> None:
    """Checks that the tools of a complete scene are those that methods can move.

    Raises:
      errors.UsageError: a method needs a wrist that the tools lack, or a task needs one that the
        method keeps straight.
    """
    from starjax.data import normalizer
    from starjax.sim import registries, wrists

    task = registries.tasks.get(scene.task)
    needs_wrist = any(wrists.per_arm(task))
    for name in selected:
        row = methods.METHODS[name]
        normalizer.wrist_of(row, wrists.holding(task, names(scene)))
        if needs_wrist and not normalizer.has_wrist(row):
            rows = methods.METHODS.items()
            known = ", ".join(name for name, one in rows if normalizer.has_wrist(one))
            expected = f"one that moves a wrist, for task {scene.task}"
            raise errors.UsageError("method", expected, name, known)
