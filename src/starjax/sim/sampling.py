"""Trocars drawn for a task: those of each arm from its own workspace."""

import jax
import jax.numpy as jnp

from starjax import rcm
from starjax.sim import registries
from starjax.sim.task import Task


def sample_trocars(key: jax.Array, task: Task, shape: tuple[int, ...] = ()) -> rcm.Trocar:
    """Draws configurations, fields `[*shape, A]`: Eq. 19 with the ranges of each workspace."""
    arms = []
    for a, slot in enumerate(task.slots):
        work = registries.workspaces.get(slot.workspace)
        arms.append(
            rcm.sample_trocar(
                # The first arm's draws are those of a task with one arm.
                jax.random.fold_in(key, a) if a else key,
                shape,
                radius_range=work.radius,
                polar_range=work.polar,
                azimuth_range=work.azimuth,
            )
        )
    return jax.tree.map(lambda *fields: jnp.stack(fields, axis=-1), *arms)
