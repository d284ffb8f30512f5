"""Flow matching: straight paths from noise to action sequences, and Euler steps along them.

Lipman et al., "Flow Matching for Generative Modeling", and Liu et al., "Flow Straight and Fast"
(both ICLR 2023). At time t a sequence is `(1 - t) x0 + t noise`: clean at 0, noise at 1. A network
learns the mean of its velocity, `noise - x0`. All arithmetic is float32.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from starjax.policies.models.diffusion import within

# Unit of the network's times, whose embedding is made for steps from 0 to about 100.
TIME_UNIT = 0.01


class NoisedFlow(NamedTuple):
    """Sequences to learn from.

    Attributes:
      x: `[B, ...]`, with noise.
      time: `[B]`, in TIME_UNIT.
      velocity: `[B, ...]`, the target of the prediction.
    """

    x: jax.Array
    time: jax.Array
    velocity: jax.Array


def noised(key: jax.Array, x0: jax.Array) -> NoisedFlow:
    """Returns clean sequences `[B, ...]`, about [-1, 1], each at a random time.

    `key` is one typed key for the whole batch.
    """
    key_time, key_noise = jax.random.split(key)
    time = jax.random.uniform(key_time, x0.shape[:1])
    noise = jax.random.normal(key_noise, x0.shape, x0.dtype)
    level = time.reshape(-1, *[1] * (x0.ndim - 1))  # [B, 1, ..]
    # x_t = (1 - t) x0 + t eps, whose derivative in t is the same all along: v = eps - x0.
    return NoisedFlow(x0 + level * (noise - x0), time / TIME_UNIT, noise - x0)


def velocity_loss(
    predict: Callable[[jax.Array, jax.Array], jax.Array], batch: NoisedFlow
) -> jax.Array:
    """Returns the mean squared error of the velocity that `predict(x, time)` returns."""
    # Its minimiser is E[v | x_t], the field that carries noise to data.
    return jnp.mean((predict(batch.x, batch.time) - batch.velocity) ** 2)


def sample(
    predict: Callable[[jax.Array, Any], jax.Array],
    noise: jax.Array,
    *,
    steps: int,
    prepare: Callable[[jax.Array], Any] = lambda time: time,
    reach: jax.Array | None = None,
) -> jax.Array:
    """Takes Euler steps of one length from `noise` `[B, ...]` to a clean sequence.

    At each step the end of the straight path is clipped to `reach`: lowest and highest value, None
    for -1 and 1.

    Args:
      predict: `(x [B, ...], prepared) -> velocity [B, ...]`.
      noise: the start, standard normal.
      steps: number of network evaluations.
      prepare: maps the times `[n]` in TIME_UNIT to a pytree with leading axis n, once, before the
        loop; `predict` gets its slice.
      reach: two bounds, each broadcast against `[B, ...]`.
    """
    time = np.arange(steps, 0, -1, dtype=np.float32) / steps  # 1, 1 - 1/n, .., 1/n: backwards

    def step(x: jax.Array, inputs: Any) -> tuple[jax.Array, None]:
        time, left, prepared = inputs
        # x = (1 - t) x0 + t noise and v = noise - x0, so x0 = x - t v; then noise at t - 1 / steps
        clean = within(x - time * predict(x, prepared), reach)
        return clean + left * (x - clean), None  # linear in t: the next point is on the same line

    left = 1.0 - 1.0 / (steps * time)  # fraction of the path that remains after the step
    rows = (jnp.asarray(time), jnp.asarray(left), prepare(jnp.asarray(time / TIME_UNIT)))
    return jax.lax.scan(step, noise, rows)[0]
