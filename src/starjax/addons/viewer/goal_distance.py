"""Distances from the tips to the points of a task's state, for an operator."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from starjax.sim import env as sim_env
from starjax.sim.state import EnvState


def make(env: sim_env.Env) -> Callable[[Any], dict[str, float]]:
    """Makes a compiled EnvState `[1]` -> name of a point, e.g. `goal` -> mm to the nearest tip."""
    task = env.task
    sizes = [field.size for field in task.fields]
    firsts = np.cumsum([0, *sizes[:-1]])
    points = {
        field.name.removesuffix(".p"): int(first)
        for field, first in zip(task.fields, firsts)
        if field.kind == "point"
    }

    @jax.jit
    def distances(state: EnvState) -> jax.Array:
        one = jax.tree.map(lambda x: x[0], state)
        values = task.state(env.scene.bound, one.layout, one.measurements)
        p = jnp.stack([values[first : first + 3] for first in points.values()])
        return jnp.linalg.norm(p[:, None] - one.pose.p, axis=-1).min(axis=-1)

    def in_mm(state: EnvState) -> dict[str, float]:
        if not points:
            return {}
        return dict(zip(points, (1e3 * np.asarray(distances(state))).tolist()))

    return in_mm
