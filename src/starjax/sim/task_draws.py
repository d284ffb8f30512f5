"""Draws of a task's reset, looked at on the host: finite, and equal with one key."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from starjax.core import errors
from starjax.runtime import user_code
from starjax.sim.scene import Scene

KEYS = 8  # resets that are looked at


class DrawFault(NamedTuple):
    """A fault of a function of the reset.

    Attributes:
      function: its name in the task's record.
      text: the part of its result, and the fault.
    """

    function: str
    text: str


def faults(scene: Scene) -> Iterator[DrawFault]:
    """Yields the faults of the first of some resets that has any."""
    for seed in range(KEYS):
        found = list(_of_reset(scene, seed))
        yield from found
        if found:
            return


def _of_reset(scene: Scene, seed: int) -> Iterator[DrawFault]:
    """Yields results that differ between two resets with one key, or are not finite."""
    rows = (jax.tree_util.tree_leaves_with_path(_reset(scene, seed)) for _ in range(2))
    for (path, first), (_, second) in zip(*rows, strict=True):
        name, part = path[0].key, jax.tree_util.keystr(path[1:])
        if not np.array_equal(first, second, equal_nan=True):
            yield DrawFault(name, f"{part} differs between two resets with one key".strip())
        elif not np.isfinite(np.asarray(first)).all():
            bad = np.flatnonzero(~np.isfinite(np.ravel(first))).tolist()
            yield DrawFault(name, f"{part} is not finite at {bad}".strip())


def require_finite(scene: Scene) -> None:
    """Raises UsageError for the first fault; it names the function and its file."""
    task = scene.task
    for fault in faults(scene):
        raise errors.UsageError(
            user_code.subject(f"task {task.name}", fault.function, getattr(task, fault.function)),
            "finite numbers that the key alone determines",
            fault.text,
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
