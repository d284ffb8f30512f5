"""Checks of a task's numbers at reset and at the end of demonstrations: success, stages, state."""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.core.types import ArrayTree
from starjax.sim.state import Env, EnvParams, EnvState
from starjax.sim.task import TaskStatus
from starjax.testing.base import Check, attempt, verdict

RESETS = 16
FARTHEST = 0.5  # m from a tip to a point of the state, at reset
UNIT = 1.001  # largest number of a rotation or of a field of kind unit
EQUAL = 1e-6  # numbers of two states that are the same


def check(env: Env) -> Iterator[Check]:
    """Yields the checks of some resets."""
    fault, states = attempt("reset", lambda: resets(env))
    yield from [fault] if fault else judged(env, states)


def resets(env: Env) -> EnvState:
    """Returns the states `[RESETS]` after resets at the task's trocars."""
    trocars = rcm.Trocar(
        *(jnp.resize(jnp.asarray(field), (RESETS, field.shape[1])) for field in env.task.trocars)
    )
    keys = jax.random.split(jax.random.key(0), RESETS)
    return jax.jit(jax.vmap(lambda key, trocar: env.reset(key, EnvParams(trocar))))(keys, trocars)


def judged(env: Env, states: EnvState) -> Iterator[Check]:
    """Yields the checks of states `[N]` at reset, as the task describes them."""
    task, bound = env.task, env.scene.bound
    seen = states.layout, states.measurements
    status = jax.device_get(jax.vmap(lambda *of: task.status(bound, *of))(*seen))
    fields = np.asarray(jax.vmap(lambda *of: task.state(bound, *of))(*seen))
    count = len(fields)
    counts = {"success": int(np.sum(status.success_now)), "lost": int(np.sum(status.lost))}
    faults = [f"{name} at step 0 in {n} of {count} resets" for name, n in counts.items() if n]
    faults += _out_of_range(env, status)
    if all(np.all(leaf == leaf[:1]) for leaf in map(np.asarray, jax.tree.leaves(states.layout))):
        faults.append(f"one layout in {count} resets with different keys")
    yield verdict("start", faults, f"no success in {count} resets, layouts differ")
    tips = np.asarray(states.pose.p)
    yield verdict("state", _unit_faults(env, fields, tips), "finite, points in m of the workspace")


def _out_of_range(env: Env, status: TaskStatus) -> Iterator[str]:
    stages = len(env.task.stages)
    if (worst := int(np.max(status.stage))) >= stages or np.min(status.stage) < 0:
        yield f"stage {worst}, expected 0 to {stages - 1}"
    low, high = float(np.min(status.reward)), float(np.max(status.reward))
    if not 0.0 <= low <= high <= 1.0:
        yield f"reward from {low:.3g} to {high:.3g}, expected within [0, 1]"


def _unit_faults(env: Env, states: np.ndarray, tips: np.ndarray) -> Iterator[str]:
    """Yields fields of the state `[N, S]` that are not finite, or in another unit than theirs."""
    ends = np.cumsum([field.size for field in env.task.fields])[:-1]
    for field, values in zip(env.task.fields, np.split(states, ends, axis=1), strict=True):
        if not np.isfinite(values).all():
            yield f"{field.name} is not finite"
        elif field.kind != "point":
            if (most := float(np.abs(values).max())) > UNIT:
                yield f"{field.name}: expected within [-1, 1], got {most:.3g}"
        elif field.size % 3 == 0:
            points = values.reshape(len(values), -1, 1, 3)
            away = np.linalg.norm(points - tips[:, None], axis=-1).min(-1)
            if (far := float(away.max())) > FARTHEST:
                yield f"{field.name} is {far:.3g} m from the tips, at most {FARTHEST:g}: in mm?"


def unrewarded(env: Env, last: EnvState) -> Iterator[str]:
    """Yields a fault if a success is worth no more than the start, where a still arm stays.

    Args:
      last: EnvState `[N]` at the end of episodes.
    """
    ended = np.flatnonzero(np.asarray(last.success))
    if not len(ended):
        return

    def reward(layout: ArrayTree, measurements: ArrayTree) -> jax.Array:
        return env.task.status(env.scene.bound, layout, measurements).reward

    first = resets(env)
    start = float(np.max(jax.vmap(reward)(first.layout, first.measurements)))
    rows = jax.tree.map(lambda x: jnp.asarray(x)[ended], (last.layout, last.measurements))
    success = float(np.min(jax.vmap(reward)(*rows)))
    if not success > start:
        yield f"{success:.3g} at success, {start:.3g} at reset"


def hidden_goals(env: Env, last: EnvState) -> Iterator[str]:
    """Yields a fault if layouts that decide on success look the same in the state.

    Each successful end is judged by the layouts of the other episodes.

    Args:
      last: EnvState `[N]` at the end of episodes.
    """
    task, bound = env.task, env.scene.bound
    ended = np.flatnonzero(np.asarray(last.success))
    if len(ended) < 2:
        return

    def seen(layout: ArrayTree, measurements: ArrayTree) -> tuple[jax.Array, jax.Array]:
        status = task.status(bound, layout, measurements)
        return status.success_now, task.state(bound, layout, measurements)

    rows = jax.tree.map(lambda x: jnp.asarray(x)[ended], (last.layout, last.measurements))
    layouts, measured = rows
    every = jax.vmap(jax.vmap(seen, (0, None)), (None, 0))  # [end, layout]
    success, states = jax.device_get(jax.jit(every)(layouts, measured))
    own = np.diagonal(states).T
    is_other = np.diagonal(success)[:, None] & ~success
    is_same = np.abs(states - own[:, None]).max(-1) < EQUAL
    if hidden := int(np.sum(is_other & is_same)):
        yield (
            f"{hidden} pairs of layouts decide on success and have the same state: is the goal "
            "in it?"
        )
