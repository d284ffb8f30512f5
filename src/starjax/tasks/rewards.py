"""Rewards in stages: the stages that are reached, and within the present one its term.

A term is in [0, 1] and counts from the stage that it is named by until the next named one.
"""

from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp


def last_reached(*conditions: jax.Array) -> jax.Array:
    """Returns the number of the last condition that holds, int32 `[]`, from 1; 0 if none does."""
    stage = jnp.zeros((), jnp.int32)
    for number, holds in enumerate(conditions, 1):
        stage = jnp.where(holds, number, stage)
    return stage.astype(jnp.int32)


def nearness(distance: jax.Array, scale: float) -> jax.Array:
    """Returns 1 at the goal and 1 / e at a `distance` of `scale`, both m."""
    return jnp.exp(-distance / scale)


def staged(
    stages: Sequence[str], terms: Mapping[str, jax.Array], stage: jax.Array, success_now: jax.Array
) -> jax.Array:
    """Returns the reward `[]` in [0, 1]: grows with the stages and within them, 1 at success.

    Args:
      stages: names, see `Task.stages`.
      terms: stage -> `[]`; the first counts from the start.
      stage: int32 `[]`.
      success_now: see `TaskStatus`.
    """
    first, *later = terms.items()
    term = first[1]
    for name, value in later:
        term = jnp.where(stage >= stages.index(name), value, term)
    return jnp.where(success_now, 1.0, (stage + term) / len(stages))
