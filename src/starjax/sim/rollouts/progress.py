"""Signals of an episode in trouble, from the simulator's state."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from starjax.sim.state import EnvState

GAIN = 0.02  # part of the reward, the least that counts as progress

CAUSES = ("none", "stalled", "clock", "nearly lost")  # causes of a takeover, by number


class BestReward(NamedTuple):
    """The best of an episode so far.

    Attributes:
      best: largest reward that counted as progress.
      step: int32, control step at which it did, or at which strict success's conditions last held.
    """

    best: jax.Array
    step: jax.Array


def begin() -> BestReward:
    """Returns the progress at reset."""
    return BestReward(jnp.zeros(()), jnp.zeros((), jnp.int32))


def update(memory: BestReward, state: EnvState, stalled_steps: int) -> tuple[BestReward, jax.Array]:
    """Returns the progress with this moment, and True if the episode has stalled.

    Args:
      memory: of the episode.
      state: EnvState.
      stalled_steps: control steps without progress after which it has.
    """
    # Held for some seconds, they end in success without another gain.
    gains = (state.reward > memory.best + GAIN) | (state.settled > 0)
    now = BestReward(
        jnp.where(gains, state.reward, memory.best), jnp.where(gains, state.step, memory.step)
    )
    return now, state.step - now.step >= stalled_steps


def cause(stalled: jax.Array, late: jax.Array, nearly_lost: jax.Array) -> jax.Array:
    """Returns the number in `CAUSES`, int32; the most urgent one counts."""
    number = jnp.where(late, 2, jnp.where(stalled, 1, 0))
    return jnp.where(nearly_lost, 3, number).astype(jnp.int32)
