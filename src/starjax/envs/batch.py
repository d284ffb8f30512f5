"""Batch of episodes as one compiled program, which also starts new ones.

Episode e of a lane starts with `fold_in(key, e)` of the lane's key, so lanes are independent.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from starjax import runtime
from starjax.core.types import Array, Tree
from starjax.envs import forked, mdp
from starjax.envs.settings import EnvSettings
from starjax.runtime.precompile import Program


class Lanes(NamedTuple):
    """N episodes in progress: keys `[N]`, int32 counts `[N]` of episodes, EnvState `[N]`."""

    key: jax.Array
    episode: jax.Array
    state: Any


class StepMode(NamedTuple):
    """Modes of one call.

    Attributes:
      reset_mask: `[N]` bool, lanes that start an episode without an action.
      move: bool, True if the other lanes act.
      autoreset: bool, True if lanes whose episode ends start the next one at once.
    """

    reset_mask: Any
    move: Any
    autoreset: Any


class BatchStep(NamedTuple):
    """Result of a call for N episodes.

    Attributes:
      now: observation and info of the states now, leaves `[N, ...]`.
      outcome: Outcome `[N]`, 0 and False for lanes in the reset mask.
      final: as `now`, but before any automatic reset.
    """

    now: tuple[Any, dict[str, jax.Array]]
    outcome: mdp.Outcome
    final: tuple[Any, dict[str, jax.Array]]


class EpisodeBatch(NamedTuple):
    """A compiled batch.

    Attributes:
      episodes: of one lane.
      empty: () -> Lanes before any episode; reset all of them.
      advance: (Lanes, actions `[N, D]`, StepMode) -> (Lanes, BatchStep).
      camera: EnvState `[N]` -> `[N, h, w, 3]` uint8.
      observed: shapes and types of one episode's observation.
    """

    episodes: mdp.Episodes
    empty: Callable[[], Lanes]
    advance: Callable[[Lanes, Any, StepMode], tuple[Lanes, BatchStep]]
    camera: Callable[[Any], jax.Array]
    observed: Any


@functools.lru_cache(8)
def make(settings: EnvSettings, lanes: int) -> EpisodeBatch:
    """Builds the programs; the same arguments give the same ones, compiled once.

    Raises:
      errors.UsageError: a setting is wrong, or this process was forked after jax had started.
    """
    forked.refuse()
    runtime.prepare_xla()
    return of_episodes(mdp.make(settings), lanes)


def of_episodes(made: mdp.Episodes, lanes: int) -> EpisodeBatch:
    """Builds the programs of N lanes of some episodes."""
    reset, step, judge = jax.vmap(made.reset), jax.vmap(made.step), jax.vmap(made.judge)
    look = jax.vmap(lambda state: (made.observe(state), made.measure(state)))

    def advance(lanes: Lanes, action: jax.Array, do: StepMode) -> tuple[Lanes, BatchStep]:
        before, reset_mask = lanes.state, do.reset_mask
        moves = do.move & ~jnp.all(reset_mask)
        after = jax.lax.cond(moves, lambda: step(before, action), lambda: before)
        raw = judge(before, after)
        outcome = jax.tree.map(lambda x: _where(reset_mask, jnp.zeros_like(x), x), raw)
        final = look(after)
        reset_mask = reset_mask | (do.autoreset & (outcome.terminated | outcome.truncated))

        def begin() -> tuple[Lanes, Any]:
            first = reset(jax.vmap(jax.random.fold_in)(lanes.key, lanes.episode))
            begun = lanes._replace(episode=lanes.episode + reset_mask, state=first)
            return _merged(reset_mask, (begun, look(first)), (lanes._replace(state=after), final))

        # Skipped if possible: a reset costs as much as a step.
        lanes, now = jax.lax.cond(
            jnp.any(reset_mask), begin, lambda: (lanes._replace(state=after), final)
        )
        return lanes, BatchStep(now, outcome, final)

    one = Program(made.reset).shapes(jax.random.key(0))

    def empty() -> Lanes:
        keys = jax.vmap(jax.random.key)(jnp.zeros(lanes, jnp.uint32))
        state = jax.tree.map(lambda s: jnp.zeros((lanes, *s.shape), s.dtype), one)
        # On a device by choice, as results of stored programs are: else `advance` compiles twice.
        return jax.device_put(
            Lanes(keys, jnp.zeros(lanes, jnp.int32), state), jax.local_devices()[0]
        )

    observed = Program(made.observe).shapes(one)
    camera = Program(jax.vmap(made.camera))
    return EpisodeBatch(made, empty, Program(advance), camera, observed)


def seeded(lanes: Lanes, seeds: np.ndarray, which: Array) -> Lanes:
    """Returns the lanes, those of `which` with keys of `seeds` `[N]` uint32 and no episode yet."""
    keys = jax.vmap(jax.random.key)(jnp.asarray(seeds))
    fresh = lanes._replace(key=keys, episode=jnp.zeros_like(lanes.episode))
    return _merged(which, fresh, lanes)


def _merged(which: Array, a: Tree, b: Tree) -> Tree:
    """Leaves `[N, ...]` of `a` where `which` `[N]`, else of `b`."""
    return jax.tree.map(lambda x, y: _where(which, x, y), a, b)


def _where(which: Array, a: jax.Array, b: jax.Array) -> jax.Array:
    return jnp.where(jnp.reshape(which, (-1,) + (1,) * (jnp.ndim(b) - 1)), a, b)
