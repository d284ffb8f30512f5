"""Draws of an episode's trocars, as chosen by `EnvSettings.trocar`."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.core import errors
from starjax.envs.settings import Chosen
from starjax.sim import sampling, trocar_region
from starjax.sim.task import Task

Draw = Callable[[jax.Array], rcm.Trocar]


def make(task: Task, trocar: Chosen) -> Draw:
    """Makes key -> trocars, fields `[A]`.

    Args:
      trocar: see `EnvSettings.trocar`.

    Raises:
      errors.UsageError: the task has no configuration of that number, or not so many arms, or a
        trocar is outside its workspace.
    """
    if trocar == "random":
        return lambda key: sampling.sample_trocars(key, task)
    if isinstance(trocar, tuple):
        fixed = _fixed(task, trocar)
        return lambda key: jax.tree.map(jnp.asarray, fixed)
    if isinstance(trocar, int):
        if not 0 <= trocar < len(task.is_seen):
            raise errors.UsageError("trocar", f"0 to {len(task.is_seen) - 1}", trocar)
        return _listed(task, np.array([trocar]))
    rows = {"seen": task.is_seen, "unseen": ~task.is_seen, "all": np.ones_like(task.is_seen)}
    return _listed(task, np.flatnonzero(rows[trocar]))


def _fixed(task: Task, trocar: tuple[Any, ...]) -> rcm.Trocar:
    """Returns a trocar given by parameters or positions, fields `[A]`."""
    reference = np.array([slot.p_world_ref for slot in task.slots], np.float32)
    is_parameters = isinstance(trocar, rcm.Trocar)
    rows = [np.asarray(row, np.float32) for row in trocar]
    count = len(rows[0]) if is_parameters else len(rows)
    if count not in (1, task.arms):
        raise errors.UsageError("trocar", f"those of {task.arms} arms", count)
    if is_parameters:
        fixed = rcm.Trocar(*(np.broadcast_to(row, (task.arms,)) for row in rows))
    else:
        places = np.broadcast_to(np.stack(rows), reference.shape)
        fixed = rcm.Trocar(*map(np.asarray, rcm.trocar_from_position(places, reference)))
    places = rcm.trocar_position(fixed, reference)
    trocar_region.check(trocar_region.of_task(task), reference, places)
    return fixed


def _listed(task: Task, rows: np.ndarray) -> Draw:
    chosen = rcm.Trocar(*(np.asarray(field, np.float32)[rows] for field in task.trocars))

    def draw(key: jax.Array) -> rcm.Trocar:
        row = jax.random.randint(key, (), 0, len(rows))
        return rcm.Trocar(*(jnp.asarray(field)[row] for field in chosen))

    return draw
