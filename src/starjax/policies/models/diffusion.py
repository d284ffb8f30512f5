"""Diffusion over action sequences: noising, the training loss, and the two ways back.

`eps_fn` is any predictor of the noise; this module has no network. All arithmetic is float32.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from starjax.policies.models import schedule as schedules
from starjax.policies.models.schedule import Schedule


def add_noise(schedule: Schedule, x0: jax.Array, k: jax.Array, noise: jax.Array) -> jax.Array:
    """Computes Eq. 7: the noisy version of `x0` `[B, ...]` after step `k` (int `[B]` or `[]`)."""
    signal = _at(schedule.sqrt_alpha_bar, k, x0.ndim)
    spread = _at(schedule.sqrt_one_minus_alpha_bar, k, x0.ndim)
    return signal * x0 + spread * noise  # a_k = sqrt(abar_k) a_0 + sqrt(1 - abar_k) eps


class Noised(NamedTuple):
    """Sequences to learn from.

    Attributes:
      x: `[B, ...]`, with noise.
      k: int32 `[B]`, the step after which they look so.
      noise: `[B, ...]`, the target of the prediction.
    """

    x: jax.Array
    k: jax.Array
    noise: jax.Array


def noised(schedule: Schedule, key: jax.Array, x0: jax.Array) -> Noised:
    """Returns clean sequences `[B, ...]`, about [-1, 1], each after a random step.

    `key` is one typed key for the whole batch.
    """
    key_k, key_noise = jax.random.split(key)
    k = jax.random.randint(key_k, x0.shape[:1], 0, schedule.steps)  # k ~ U{0, .., K - 1}, one a row
    noise = jax.random.normal(key_noise, x0.shape, x0.dtype)  # eps ~ N(0, I)
    return Noised(add_noise(schedule, x0, k, noise), k, noise)


def eps_loss(eps_fn: Callable[[jax.Array, jax.Array], jax.Array], batch: Noised) -> jax.Array:
    """Computes Eq. 9: mean squared error of the noise that `eps_fn(x, k)` `[B, ...]` predicts."""
    return jnp.mean((eps_fn(batch.x, batch.k) - batch.noise) ** 2)


def sample_noise(keys: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Draws standard normal `[B, *shape]`; row i depends on `keys[i]` alone."""
    # A key a row: a trial's noise is the same in any batch.
    return jax.vmap(lambda key: jax.random.normal(key, shape, jnp.float32))(keys)


def ddim_sample(
    eps_fn: Callable[[jax.Array, Any], jax.Array],
    noise: jax.Array,
    *,
    diffusion_steps: int = 100,
    steps: int = 10,
    prepare: Callable[[jax.Array], Any] = lambda k: k,
    reach: jax.Array | None = None,
) -> jax.Array:
    """Samples by deterministic DDIM (eta = 0, 'leading' steps, clean sequence in `reach`).

    Args:
      eps_fn: `(x [B, ...], prepared) -> eps [B, ...]`.
      noise: the start, standard normal `[B, ...]`; see `sample_noise`.
      diffusion_steps: K of the cosine schedule that the network was trained with.
      steps: number of network evaluations.
      prepare: maps the int32 steps `[n]` to a pytree with leading axis n, once, before the loop;
        `eps_fn` gets its slice. By default the step k itself, int32 `[]`.
      reach: lowest and highest value, each broadcast against `[B, ...]`; None: -1 and 1.

    Returns:
      Clean sequences, the shape of `noise`, within `reach`.
    """
    table = schedules.ddim_table(diffusion_steps, steps)
    # All embeddings of k at once: they depend on no sample.
    prepared = prepare(jnp.asarray(table.k))

    def step(x, inputs):
        row, at_k = inputs
        eps = eps_fn(x, at_k)
        # DDIM with eta = 0 (Song et al., 2021, Eq. 12): predict x0, then go to the next noise level
        x0 = (x - row.sqrt_one_minus_alpha_bar * eps) / row.sqrt_alpha_bar
        # Data lie in `reach`: the clip keeps an error of eps, which sqrt(abar) = 5e-4 divides at
        # first, from leaving it.
        x0 = within(x0, reach)
        # Eq. 7 at k - K / n
        x = row.sqrt_alpha_bar_next * x0 + row.sqrt_one_minus_alpha_bar_next * eps
        return x, None

    rows = jax.tree.map(jnp.asarray, table)
    x, _ = jax.lax.scan(step, noise, (rows, prepared))  # one trace of the network for n steps
    return x


def within(x: jax.Array, reach: jax.Array | None) -> jax.Array:
    """Clips `x` to the lowest and highest value of `reach`, None: to [-1, 1]."""
    if reach is None:
        return jnp.clip(x, -1.0, 1.0)
    low, high = (jnp.broadcast_to(jnp.asarray(bound), x.shape) for bound in reach)
    return jnp.clip(x, low, high)


def _at(table: np.ndarray, k: jax.Array, ndim: int) -> jax.Array:
    """Returns `table[k]` with the axes that broadcast against `[B, ...]` of `ndim` axes."""
    row = jnp.asarray(table)[k]
    return row.reshape(row.shape + (1,) * (ndim - row.ndim)) if row.ndim else row
