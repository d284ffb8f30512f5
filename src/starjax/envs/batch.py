"""A batch of episodes as one compiled program, which also begins new ones.

Episode e of a lane begins with `fold_in(key, e)` of the lane's key, so what a lane goes through
does not depend on the others.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from starjax import runtime
from starjax.envs import mdp
from starjax.envs.settings import EnvSettings


class Lanes(NamedTuple):
    """N episodes under way: keys `[N]`, `[N]` int32 episodes begun, EnvState `[N]`."""

    key: jax.Array
    episode: jax.Array
    state: Any


class StepMode(NamedTuple):
    """Functions of a batch of episodes.

    Attributes:
      reset_mask: `[N]` bool; these lanes begin an episode and take no action.
      move: bool; whether the others act, or stay.
      autoreset: bool; whether those whose episode ends begin the next one at once.
    """

    reset_mask: Any
    move: Any
    autoreset: Any


class BatchStep(NamedTuple):
    """Result of a call for N episodes.

    Attributes:
      now: observation and info of the states now, leaves `[N, ...]`.
      outcome: Outcome `[N]`; of lanes that were to be restarted 0 and False.
      final: as `now`, before lanes whose episode ended in this step began the next one.
    """

    now: tuple[Any, dict[str, jax.Array]]
    outcome: mdp.Outcome
    final: tuple[Any, dict[str, jax.Array]]


class EpisodeBatch(NamedTuple):
    """A compiled batch.

    Attributes:
      episodes: of one lane.
      empty: () -> Lanes before any episode; all are to be restarted.
      advance: (Lanes, actions `[N, D]`, StepMode) -> (Lanes, BatchStep).
      camera: EnvState `[N]` -> `[N, h, w, 3]` uint8.
      observed: shapes and types of what one episode shows.
    """

    episodes: mdp.Episodes
    empty: Callable[[], Lanes]
    advance: Callable[[Lanes, Any, StepMode], tuple[Lanes, BatchStep]]
    camera: Callable[[Any], jax.Array]
    observed: Any


@functools.lru_cache(8)
def make(settings: EnvSettings, lanes: int) -> EpisodeBatch:
    """Builds the programs; the same arguments give the same ones, compiled once."""
    runtime.prepare_xla()
    made = mdp.make(settings)
    reset, step, judge = jax.vmap(made.reset), jax.vmap(made.step), jax.vmap(made.judge)
    look = jax.vmap(lambda state: (made.observe(state), made.measure(state)))

    def advance(lanes: Lanes, action: Any, do: StepMode) -> tuple[Lanes, BatchStep]:
        before, reset_mask = lanes.state, do.reset_mask
        moves = do.move & ~jnp.all(reset_mask)
        after = jax.lax.cond(moves, lambda: step(before, action), lambda: before)
        found = judge(before, after)
        outcome = jax.tree.map(lambda x: _where(reset_mask, jnp.zeros_like(x), x), found)
        final = look(after)
        reset_mask = reset_mask | (do.autoreset & (outcome.terminated | outcome.truncated))

        def begin() -> tuple[Lanes, Any]:
            first = reset(jax.vmap(jax.random.fold_in)(lanes.key, lanes.episode))
            begun = lanes._replace(episode=lanes.episode + reset_mask, state=first)
            return _merged(reset_mask, (begun, look(first)), (lanes._replace(state=after), final))

        # Rarely needed, and as dear as a step.
        lanes, now = jax.lax.cond(
            jnp.any(reset_mask), begin, lambda: (lanes._replace(state=after), final)
        )
        return lanes, BatchStep(now, outcome, final)

    one = jax.eval_shape(made.reset, jax.random.key(0))

    def empty() -> Lanes:
        keys = jax.vmap(jax.random.key)(jnp.zeros(lanes, jnp.uint32))
        state = jax.tree.map(lambda s: jnp.zeros((lanes, *s.shape), s.dtype), one)
        return Lanes(keys, jnp.zeros(lanes, jnp.int32), state)

    observed = jax.eval_shape(made.observe, one)
    return EpisodeBatch(made, empty, jax.jit(advance), jax.jit(jax.vmap(made.camera)), observed)


def seeded(lanes: Lanes, seeds: Any, which: Any) -> Lanes:
    """Some lanes with keys of these seeds `[N]` uint32, before their first episode."""
    keys = jax.vmap(jax.random.key)(jnp.asarray(seeds))
    fresh = lanes._replace(key=keys, episode=jnp.zeros_like(lanes.episode))
    return _merged(which, fresh, lanes)


def _merged(which: Any, a: Any, b: Any) -> Any:
    """Leaves `[N, ...]` of `a` where `which` `[N]`, else of `b`."""
    return jax.tree.map(lambda x, y: _where(which, x, y), a, b)


def _where(which: Any, a: Any, b: Any) -> jax.Array:
    return jnp.where(jnp.reshape(which, (-1,) + (1,) * (jnp.ndim(b) - 1)), a, b)
