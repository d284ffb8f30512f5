"""ExpertEpisodes of a scripted expert by themselves: successes, times, and causes of failure.

Demonstrations are worth as much as their expert: `starjax check` and the benchmark of experts run
this before anything is trained.
"""

import time
from collections import Counter
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.core.types import Agent, Command
from starjax.data import stillness
from starjax.evaluation import statistics
from starjax.sim import collision, dynamics, ik, physics
from starjax.sim import env as envs
from starjax.sim import scene as scenes
from starjax.sim.state import EnvState

CHUNK = {"cpu": 16}  # episodes at once
CHUNK_GPU = 600


class ExpertEpisodes(NamedTuple):
    """ExpertEpisodes N of an expert, on the host.

    Attributes:
      last: EnvState at the end; of an invalid episode its last sound state.
      command: executed in the last step.
      at_collision: EnvState after the first step that collided, else the initial one.
      errors: `[N, T]` m, executed RCM error of the arm that is farthest off.
      still: `[N, T]` bool, the command to record is nearly that of the step before.
      finite: `[N]` bool, the task's state was finite at every step.
      apart: `[N]` m, largest distance between executed and recorded tips.
      wall_s: s to compile and run.
    """

    last: EnvState
    command: Command
    at_collision: EnvState
    errors: np.ndarray
    still: np.ndarray
    finite: np.ndarray
    apart: np.ndarray
    wall_s: float


def run(
    env: envs.Env, agent: Agent, trocars: rcm.Trocar, key: jax.Array, steps: int
) -> ExpertEpisodes:
    """Runs an episode at each configuration of trocars `[N, A]`, of at most `steps` steps."""
    count = len(trocars.radius)
    chunk = min(count, CHUNK.get(jax.default_backend(), CHUNK_GPU))
    keys = jax.random.split(key, count)
    simulate = jax.jit(jax.vmap(lambda key, trocar: _episode(env, agent, key, trocar, steps)))
    start, parts = time.perf_counter(), []
    for first in range(0, count, chunk):
        # The last chunk is filled up with its first lanes, which are not counted.
        index = np.resize(np.arange(first, min(first + chunk, count)), chunk)
        part = simulate(keys[index], jax.tree.map(lambda leaf, i=index: leaf[i], trocars))
        parts.append(jax.tree.map(lambda leaf, f=first: np.asarray(leaf)[: count - f], part))
    joined = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    return ExpertEpisodes(*joined, wall_s=time.perf_counter() - start)


def part(episodes: ExpertEpisodes, rows: slice) -> ExpertEpisodes:
    """Returns some of the episodes."""
    wall_s = episodes.wall_s
    some = jax.tree.map(lambda leaf: leaf[rows], episodes._replace(wall_s=None))
    return some._replace(wall_s=wall_s)


def longest_rests(episodes: ExpertEpisodes, settle_steps: int) -> np.ndarray:
    """Returns `[M]`, the longest still stretch of each success, in control steps.

    The last `settle_steps` do not count: there the task is done, and its judge waits. A task that
    settles in one step judges whole episodes: its tool may rest with an object that it follows.
    """
    ends = np.asarray(episodes.last.step) * (settle_steps > 1) - settle_steps
    return np.array(
        [
            stillness.stretches(episodes.still[i, : max(ends[i], 0)]).max(initial=0)
            for i in np.flatnonzero(episodes.last.success)
        ],
        int,
    )


def summary(episodes: ExpertEpisodes, env: envs.Env) -> dict[str, Any]:
    """Returns counts, the success rate with its 95 % interval, times, stillness and RCM errors."""
    last, steps = episodes.last, episodes.errors.shape[1]
    count, success = len(last.success), np.asarray(last.success)
    rests = longest_rests(episodes, env.task.settle_steps)
    low, high = statistics.wilson(int(success.sum()), count)
    executed = episodes.errors[np.arange(steps) < np.asarray(last.step)[:, None]] * 1e3
    return {
        "episodes": count,
        "successes": int(success.sum()),
        "rate": float(success.mean()),
        "ci95": [low, high],
        "collided": int(last.collided.sum()),
        "collided_successes": int((last.collided & success).sum()),
        "invalid": int(last.invalid.sum()),
        "median_transfer_s": float(np.median(last.step[success])) / env.control_hz,
        "longest_rest": int(rests.max(initial=0)),
        "resting": int((rests > stillness.MOST).sum()),
        "rcm_error_mm": {
            "mean": float(executed.mean()),
            "p99": float(np.quantile(executed, 0.99)),
            "max": float(executed.max()),
        },
        "wall_s": episodes.wall_s,
    }


def collisions(scene: scenes.Scene, episodes: ExpertEpisodes) -> Counter[str]:
    """Counts the pairs that overlapped at the first collision of each episode."""
    return _count(
        lambda state: _pairs(scene, state),
        np.asarray(episodes.last.collided),
        episodes.at_collision,
    )


def faults(scene: scenes.Scene, episodes: ExpertEpisodes) -> Counter[str]:
    """Counts the reasons for which episodes ended as invalid."""

    def reasons(state: EnvState, command: Command) -> dict[str, jax.Array]:
        _, after, error = dynamics.attempt(scene, state, command)
        speeds = [jnp.max(jnp.abs(after.qvel[bound.dof])) for bound in scene.arms]
        finite = jax.tree.map(lambda x: jnp.all(jnp.isfinite(x)), after)
        return {
            "positions or speeds that are not finite": ~jnp.all(jnp.stack(jax.tree.leaves(finite))),
            f"a joint above {physics.MAX_ARM_SPEED:g} rad/s": jnp.max(jnp.stack(speeds))
            > physics.MAX_ARM_SPEED,
            "the task's is_sound": ~scene.task.is_sound(scene.bound, after.qpos, after.qvel),
            "the contact solver did not converge": ~(error < dynamics.max_solver_error(scene)),
        }

    is_invalid = np.asarray(episodes.last.invalid)
    return _count(reasons, is_invalid, episodes.last, episodes.command)


def _count(
    causes: Callable[..., dict[str, jax.Array]], which: np.ndarray, *arguments: Any
) -> Counter[str]:
    """Counts the causes that hold in the episodes `which` `[N]` bool."""
    if not which.any():
        return Counter()
    chosen = jax.tree.map(lambda leaf: leaf[which], arguments)
    held = jax.jit(jax.vmap(causes))(*chosen)
    return Counter({name: int(np.sum(hit)) for name, hit in held.items() if np.any(hit)})


def _pairs(scene: scenes.Scene, state: EnvState) -> dict[str, jax.Array]:
    p_world_trocar = state.trocar.p_world_trocar
    origins = [
        ik.forward(scenes.chain_at(bound, p_world_trocar[a]), state.physics.qpos[bound.q])[1]
        for a, bound in enumerate(scene.arms)
    ]
    obstacles = scene.task.obstacles(scene.bound, state.layout, state.measurements)
    return collision.pairs(
        scene.arms, state.pose, origins, p_world_trocar, obstacles, scene.task.floor, state.shaft
    )


def _episode(
    env: envs.Env, agent: Agent, key: jax.Array, trocar: rcm.Trocar, steps: int
) -> tuple[EnvState, Command, EnvState, jax.Array, jax.Array, jax.Array, jax.Array]:
    key_reset, key_expert = jax.random.split(key)
    first = env.reset(key_reset, envs.EnvParams(trocar))

    def step(carry: Any) -> Any:
        state, memory, _, hit, largest, before, still, finite, apart = carry
        command, memory, label = agent.act(memory, state)
        after = env.step(state, command)
        is_first = after.collided & ~state.collided
        hit = jax.tree.map(lambda new, old: jnp.where(is_first, new, old), after, hit)
        largest = largest.at[state.step].set(jnp.max(after.rcm_error))
        still = still.at[state.step].set(stillness.is_still(before, label))
        offset = jnp.linalg.norm(command.pose.p - label.pose.p, axis=-1)
        apart, finite = jnp.maximum(apart, jnp.max(offset)), finite & _is_finite(env, after)
        return after, memory, command, hit, largest, label, still, finite, apart

    memory = agent.init(key_expert, first)
    has_angles = jax.eval_shape(agent.act, memory, first)[0].wrist is not None
    hold = Command(first.pose, first.gripper, first.wrist if has_angles else None)
    start = (
        *(first, memory, hold, first),
        *(jnp.zeros(steps), hold, jnp.zeros(steps, bool), _is_finite(env, first), jnp.zeros(())),
    )
    state, _, command, hit, largest, _, still, finite, apart = jax.lax.while_loop(
        lambda carry: ~carry[0].done & (carry[0].step < steps), step, start
    )
    # Memories of disturbances hold keys, which no array on the host can.
    state, hit = (one.replace(wrapper_state={}) for one in (state, hit))
    return state, command, hit, largest, still, finite, apart


def _is_finite(env: envs.Env, state: EnvState) -> jax.Array:
    task = env.task
    return jnp.all(jnp.isfinite(task.state(env.scene.bound, state.layout, state.measurements)))
