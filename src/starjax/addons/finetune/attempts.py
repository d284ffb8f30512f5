"""An agent that tries the same trials several times, with other noise."""

import functools
from collections.abc import Callable
from typing import Any

import jax

from starjax.rollouts import episodes, placement
from starjax.rollouts.agent import BatchAgent, Observe


def repeated(agent: BatchAgent) -> BatchAgent:
    """Makes the agent; its parameters are (those of the agent, numbers of the attempts `[N]`)."""
    split = (agent.split, placement.LANE)
    return BatchAgent(*_functions(agent.init, agent.act), agent.about, split)


@functools.lru_cache(maxsize=4)  # programs belong to the functions that they were made of
def _functions(
    begin: Callable[..., Any], decide: Callable[..., Any]
) -> tuple[Callable[..., Any], Callable[..., Any]]:
    def init(params: Any, keys: jax.Array, state: Any, observe: Observe) -> Any:
        keys = jax.vmap(jax.random.fold_in, (0, 0))(keys, params[1])
        return begin(params[0], keys, state, observe)

    def act(params: Any, memory: Any, state: Any, observe: Observe, t: jax.Array) -> Any:
        return decide(params[0], memory, state, observe, t)

    return init, act


# A demonstration's fields without images, of an image policy and of one that sees the state.
RECORDS = {
    "image": episodes.SCORE._replace(fields=episodes.without_images),
    "state": episodes.SCORE._replace(fields=episodes.without_images, observes=True),
}
