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
from starjax.envs import episodes
from starjax.envs.settings import Settings


class Lanes(NamedTuple):
    """N episodes under way: keys `[N]`, `[N]` int32 episodes begun, EnvState `[N]`."""

    key: jax.Array
    episode: jax.Array
    state: Any


class Do(NamedTuple):
    """Functions of a batch of episodes.

    Attributes:
      restart: `[N]` bool; these lanes begin an episode and take no action.
      move: bool; whether the others act, or stay.
      anew: bool; whether those whose episode ends begin the next one at once.
    """

    restart: Any
    move: Any
    anew: Any


class Step(NamedTuple):
    """Result of a call for N episodes.

    Attributes:
      now: observation and info of the states now, leaves `[N, ...]`.
      outcome: Outcome `[N]`; of lanes that were to be restarted 0 and False.
      last: as `now`, before lanes whose episode ended in this step began the next one.
    """

    now: tuple[Any, dict[str, jax.Array]]
    outcome: episodes.Outcome
    last: tuple[Any, dict[str, jax.Array]]


class Batch(NamedTuple):
    """A compiled batch.

    Attributes:
      episodes: of one lane.
      empty: () -> Lanes before any episode; all are to be restarted.
      advance: (Lanes, actions `[N, D]`, Do) -> (Lanes, Step).
      camera: EnvState `[N]` -> `[N, h, w, 3]` uint8.
      observed: shapes and types of what one episode shows.
    """

    episodes: episodes.Episodes
    empty: Callable[[], Lanes]
    advance: Callable[[Lanes, Any, Do], tuple[Lanes, Step]]
    camera: Callable[[Any], jax.Array]
    observed: Any


@functools.lru_cache(8)
def make(settings: Settings, lanes: int) -> Batch:
    """Builds the programs; the same arguments give the same ones, compiled once."""
    runtime.prepare_xla()
    made = episodes.make(settings)
    reset, step, judge = jax.vmap(made.reset), jax.vmap(made.step), jax.vmap(made.judge)
    look = jax.vmap(lambda state: (made.observe(state), made.measure(state)))

    def advance(lanes: Lanes, action: Any, do: Do) -> tuple[Lanes, Step]:
        before, restart = lanes.state, do.restart
        moves = do.move & ~jnp.all(restart)
        after = jax.lax.cond(moves, lambda: step(before, action), lambda: before)
        found = judge(before, after)
        outcome = jax.tree.map(lambda x: _where(restart, jnp.zeros_like(x), x), found)
        last = look(after)
        restart = restart | (do.anew & (outcome.terminated | outcome.truncated))

        def begin() -> tuple[Lanes, Any]:
            first = reset(jax.vmap(jax.random.fold_in)(lanes.key, lanes.episode))
            begun = lanes._replace(episode=lanes.episode + restart, state=first)
            return _merged(restart, (begun, look(first)), (lanes._replace(state=after), last))

        # Rarely needed, and as dear as a step.
        lanes, now = jax.lax.cond(
            jnp.any(restart), begin, lambda: (lanes._replace(state=after), last)
        )
        return lanes, Step(now, outcome, last)

    one = jax.eval_shape(made.reset, jax.random.key(0))

    def empty() -> Lanes:
        keys = jax.vmap(jax.random.key)(jnp.zeros(lanes, jnp.uint32))
        state = jax.tree.map(lambda s: jnp.zeros((lanes, *s.shape), s.dtype), one)
        return Lanes(keys, jnp.zeros(lanes, jnp.int32), state)

    observed = jax.eval_shape(made.observe, one)
    return Batch(made, empty, jax.jit(advance), jax.jit(jax.vmap(made.camera)), observed)


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
