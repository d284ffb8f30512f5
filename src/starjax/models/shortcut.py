"""Shortcut models: flow matching whose network also knows how far it is to step, up to all the way.

Frans et al., "One Step Diffusion via Shortcut Models" (ICLR 2025). A step of length d from time t
ends in `x - d v`, and the network learns the mean velocity v over the step: of no length, flow
matching's (`models.flow`); of length 2 d, what two steps of its own of length d add up to. So one
training teaches one step and many, without a teacher that must be trained before.

Other than there, targets come from the weights in training, not from their average.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from starjax.models import flow
from starjax.models.diffusion import within

# Steps have lengths 1/2, 1/4, ... by level; at the last level the length counts as none.
LEVELS = 7
EVERY = 4  # one of so many sequences teaches steps that have a length
# A time tells the length too: levels are this far apart, in `flow.TIME_UNIT`, of which a time
# has 100. The network's embedding then tells them apart as it tells times.
LEVEL_UNIT = 200.0


class Noised(NamedTuple):
    """Sequences to learn from.

    Attributes:
      x: `[B, ...]`, with noise.
      time: `[B]` in [0, 1], 1 is noise.
      level: int32 `[B]`, LEVELS where the velocity is to be predicted, else the step's.
      velocity: `[B, ...]`.
    """

    x: jax.Array
    time: jax.Array
    level: jax.Array
    velocity: jax.Array


def told(time: Any, level: Any) -> Any:
    """One number for a time in [0, 1] and a step's level, as the network is told them."""
    return time / flow.TIME_UNIT + LEVEL_UNIT * level


def noised(key: jax.Array, x0: jax.Array) -> Noised:
    """Clean sequences `[B, ...]`, about [-1, 1], each at a random time.

    `key` is one typed key for the whole batch. Steps of level l begin at multiples of their length,
    2^-l, as those of a sampler do.
    """
    key_time, key_level, key_noise = jax.random.split(key, 3)
    count = len(x0)
    steps = jnp.arange(count) % EVERY == 0
    level = jnp.where(steps, jax.random.randint(key_level, (count,), 0, LEVELS), LEVELS)
    time = jax.random.uniform(key_time, (count,))
    pieces = 2.0**level
    time = jnp.where(steps, (jnp.floor(time * pieces) + 1.0) / pieces, time)
    noise = jax.random.normal(key_noise, x0.shape, x0.dtype)
    share = _beside(time, x0)
    return Noised(x0 + share * (noise - x0), time, level, noise - x0)


def loss(predict: Callable[..., jax.Array], given: Noised) -> jax.Array:
    """Mean squared error of the mean velocity.

    It is what `predict(x, told)` `[B, ...]` predicts, of some rows `predict(x, told, rows)`.
    """
    target = jax.lax.stop_gradient(targets(predict, given))
    return jnp.mean((predict(given.x, told(given.time, given.level)) - target) ** 2)


def targets(predict: Callable[..., jax.Array], given: Noised) -> jax.Array:
    """Target of the prediction `[B, ...]`: for a step with a length, the mean of two of half."""
    count = len(given.x)
    most = -(-count // EVERY)
    (rows,) = jnp.nonzero(given.level < LEVELS, size=most, fill_value=count)
    there = jnp.minimum(rows, count - 1)  # fewer than `most` in a share of the batch, perhaps
    x, time, level = given.x[there], given.time[there], given.level[there]
    half = 2.0 ** -(level + 1.0)
    first = predict(x, told(time, level + 1), there)
    second = predict(x - _beside(half, x) * first, told(time - half, level + 1), there)
    return given.velocity.at[rows].set(0.5 * (first + second), mode="drop")


def sample(
    predict: Callable[[jax.Array, Any], jax.Array],
    noise: jax.Array,
    *,
    steps: int,
    prepare: Callable[[jax.Array], Any] = lambda time: time,
    reach: Any = None,
) -> jax.Array:
    """Steps of one length from `noise` `[B, ...]` to a clean sequence, clipped to `reach`.

    Args:
      predict: `(x [B, ...], prepared) -> velocity [B, ...]`.
      noise: the start, standard normal.
      steps: how many network evaluations, a power of two of at most 2^LEVELS.
      prepare: maps what is told `[n]` to a pytree with leading axis n, once, before the loop;
        `predict` gets its slice.
      reach: lowest and highest value, what broadcasts against `[B, ...]` each; None: -1 and 1.
    """
    time = np.arange(steps, 0, -1, dtype=np.float32) / steps
    level = np.float32(np.log2(steps))

    def step(x: jax.Array, prepared: Any) -> tuple[jax.Array, None]:
        return x - predict(x, prepared) / steps, None

    return within(jax.lax.scan(step, noise, prepare(jnp.asarray(told(time, level))))[0], reach)


def _beside(numbers: jax.Array, x: jax.Array) -> jax.Array:
    """`[B]` with the axes that broadcast against `x` `[B, ...]`."""
    return numbers.reshape(-1, *[1] * (x.ndim - 1)).astype(x.dtype)
