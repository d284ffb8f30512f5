"""Draws of an episode's trocars, as chosen by `EnvSettings.trocar`."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from starjax import errors, rcm
from starjax.sim import sampling
from starjax.sim.tasks.base import Task

Draw = Callable[[jax.Array], rcm.Trocar]


def make(task: Task, trocar: str | int | tuple) -> Draw:
    """Makes key -> trocars, fields `[A]`.

    Raises:
      errors.UsageError: the task has no configuration of that number, or not so many arms.
    """
    if trocar == "random":
        return lambda key: sampling.sample_trocars(key, task)
    if isinstance(trocar, tuple):
        fields = [np.asarray(field, np.float32) for field in trocar]
        if fields[0].shape not in ((1,), (task.arms,)):
            raise errors.UsageError("trocar", f"fields of {task.arms}", f"{len(fields[0])}")
        fixed = rcm.Trocar(*(np.broadcast_to(field, (task.arms,)) for field in fields))
        return lambda key: jax.tree.map(jnp.asarray, fixed)
    if isinstance(trocar, int):
        if not 0 <= trocar < len(task.is_seen):
            raise errors.UsageError("trocar", f"0 to {len(task.is_seen) - 1}", trocar)
        return _listed(task, np.array([trocar]))
    rows = {"seen": task.is_seen, "unseen": ~task.is_seen, "all": np.ones_like(task.is_seen)}
    return _listed(task, np.flatnonzero(rows[trocar]))


def _listed(task: Task, rows: np.ndarray) -> Draw:
    chosen = rcm.Trocar(*(np.asarray(field, np.float32)[rows] for field in task.trocars))

    def draw(key: jax.Array) -> rcm.Trocar:
        row = jax.random.randint(key, (), 0, len(rows))
        return rcm.Trocar(*(jnp.asarray(field)[row] for field in chosen))

    return draw
