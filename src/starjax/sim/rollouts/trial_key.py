"""Keys of trials, for programs that run or draw a single one."""

import jax

from starjax.core.types import Pose
from starjax.sim import registries, scene
from starjax.sim.names import SceneNames


def of_trial(seed: int, trocar: int, trial: int, stream: int | None = None) -> jax.Array:
    """Returns the key that a trial has in `rollouts.engine`."""
    key = jax.random.key(seed)
    key = key if stream is None else jax.random.fold_in(key, stream)
    return jax.random.fold_in(jax.random.fold_in(key, trocar), trial)


def of_reset(seed: int, trocar: int, trial: int, stream: int | None = None) -> jax.Array:
    """Returns the half of a trial's key that its environment is reset with."""
    return jax.random.split(of_trial(seed, trocar, trial, stream))[0]


def bodies_at_rest(
    names: SceneNames, seed: int | None, trocar: int, trial: int, stream: int | None = None
) -> Pose | None:
    """Returns the poses `[K]` of `Task.still` in a recorded trial; None without them or a seed."""
    task = registries.tasks.get(names.task)
    if task.still is None or seed is None:
        return None
    reset = of_reset(seed, trocar, trial, stream)
    return jax.device_get(task.still(task.sample(task.bind(scene.compose(names)), reset)))
