"""Draws of a task's reset, looked at on the host: finite, and equal with one key."""

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from starjax.core import errors
from starjax.runtime import user_code
from starjax.sim.scene import Scene

KEYS = 8  # resets that are looked at


def faults(scene: Scene) -> Iterator[tuple[str, str]]:
    """Yields the faults of the first of some resets that has any.

    Each is the name of a function in the task's record, and the part of its result with the fault.
    """
    for seed in range(KEYS):
        found = list(_of_reset(scene, seed))
        yield from found
        if found:
            return


def _of_reset(scene: Scene, seed: int) -> Iterator[tuple[str, str]]:
    """Yields results that differ between two resets with one key, or are not finite."""
    rows = (jax.tree_util.tree_leaves_with_path(_reset(scene, seed)) for _ in range(2))
    for (path, first), (_, second) in zip(*rows, strict=True):
        name, part = path[0].key, jax.tree_util.keystr(path[1:])
        if not np.array_equal(first, second, equal_nan=True):
            yield name, f"{part} differs between two resets with one key".strip()
        elif not np.isfinite(np.asarray(first)).all():
            bad = np.flatnonzero(~np.isfinite(np.ravel(first))).tolist()
            yield name, f"{part} is not finite at {bad}".strip()


def require_finite(scene: Scene) -> None:
    """Raises UsageError for the first fault; it names the function and its file."""
    task = scene.task
    for function, fault in faults(scene):
        raise errors.UsageError(
            user_code.subject(f"task {task.name}", function, getattr(task, function)),
            "finite numbers that the key alone determines",
            fault,
            f"starjax check {task.name}",
        )


def _reset(scene: Scene, seed: int) -> dict[str, Any]:
    """Returns the results of a reset's functions, by their names."""
    task, key = scene.task, jax.random.key(seed)
    layout = task.sample(scene.bound, key)
    qpos = jnp.asarray(scene.mj_model.qpos0, jnp.float32)
    return {
        "sample": layout,
        "tips": task.tips(scene.bound, layout, jnp.asarray(scene.p_world_ref)),
        "place_objects": task.place_objects(scene.bound, qpos, layout),
        "label": task.label(layout),
    }
