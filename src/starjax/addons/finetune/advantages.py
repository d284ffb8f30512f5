"""Advantages of decisions in episodes that end with one reward."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

DISCOUNT = 0.99  # gamma, of a decision
TRACE = 0.95  # lambda of the exponential average


class Estimates(NamedTuple):
    """Advantages of the decisions of N episodes.

    Attributes:
      advantage: `[N, R]`, 0 after the end.
      returns: `[N, R]`, targets of the values.
    """

    advantage: jax.Array
    returns: jax.Array


def estimate(reward: jax.Array, value: jax.Array, alive: jax.Array) -> Estimates:
    """Returns generalised advantage estimates (Schulman et al., arXiv:1506.02438).

    An episode that reaches the limit ends with value 0, like a failed one.

    Args:
      reward: `[N, R]` of the decisions.
      value: `[N, R]` of the states before them.
      alive: `[N, R]` bool, False after the end.
    """
    value = jnp.where(alive, value, 0.0)
    following = jnp.pad(value[:, 1:], ((0, 0), (0, 1)))
    error = jnp.where(alive, reward + DISCOUNT * following - value, 0.0)

    def back(later: jax.Array, now: jax.Array) -> tuple[jax.Array, jax.Array]:
        # A_r = delta_r + gamma lambda A_{r+1}, Eq. 16
        total = now + DISCOUNT * TRACE * later
        return total, total

    _, found = jax.lax.scan(back, jnp.zeros(len(error)), error.T, reverse=True)
    advantage = jnp.where(alive, found.T, 0.0)
    return Estimates(advantage, advantage + value)


def standardised(advantage: jax.Array, alive: jax.Array) -> jax.Array:
    """Returns advantages `[N, R]` with mean 0 and deviation 1 over the decisions `alive`."""
    mean = jnp.mean(advantage, where=alive)
    deviation = jnp.std(advantage, where=alive)
    return jnp.where(alive, (advantage - mean) / (deviation + 1e-8), 0.0)
