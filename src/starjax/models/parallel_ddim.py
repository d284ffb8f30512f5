"""DDIM whose steps are computed side by side, in half as many evaluations of the network.

To predict one robot's action a GPU reads every weight at every step, and that takes as long as
ten sequences' arithmetic. So the network sees the sequences of all steps at once, as far as they
are known (Picard iteration; Shih et al., "Parallel Sampling of Diffusion Models", 2023), and after
each evaluation they are put together anew, each step's clean sequence being taken for a linear
function of its noisy one whose slope is that between the last two evaluations (a secant).

Where the iteration ends is `diffusion.ddim_sample`'s own sequence; after as many evaluations as
steps it is there whatever the network.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from starjax.models import layers
from starjax.models import schedule as schedules

EVALUATIONS = 5
# Sequences that a GPU evaluates in little more time than one: it waits for the weights.
_SEQUENCES = 10
_TINY = 1e-12  # squared distance of sequences that count as the same


def pays(batch: int, steps: int) -> bool:
    """Whether so many sequences take less time here than step by step."""
    return layers.on_gpu() and steps > EVALUATIONS and batch * steps <= _SEQUENCES


def ddim_sample(
    eps_fn: Callable[[jax.Array, Any], jax.Array],
    noise: jax.Array,
    *,
    diffusion_steps: int = 100,
    steps: int = 10,
    evaluations: int = EVALUATIONS,
    prepare: Callable[[jax.Array], Any] = lambda k: k,
    reach: Any = None,
) -> jax.Array:
    """`diffusion.ddim_sample`, approximately.

    Args:
      eps_fn: `(x [steps, B, H, A], prepared) -> eps [steps, B, H, A]`.
      noise: the start, standard normal `[B, H, A]`.
      diffusion_steps: K of the cosine schedule that the network was trained with.
      steps: n of DDIM.
      evaluations: of the network, with n sequences for each of B.
      prepare: maps the int32 steps `[n]` to a pytree with leading axis n, once; `eps_fn` gets it.
      reach: lowest and highest value, what broadcasts against `[B, H, A]` each; None: -1 and 1.

    Returns:
      Clean sequences `[B, H, A]` within `reach`.
    """
    table = jax.tree.map(jnp.asarray, schedules.ddim_table(diffusion_steps, steps))
    prepared = prepare(table.k)
    low, high = (-1.0, 1.0) if reach is None else reach
    signal, spread = (
        _beside(row) for row in (table.sqrt_alpha_bar, table.sqrt_one_minus_alpha_bar)
    )

    def through(x0: jax.Array, at: jax.Array, slope: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The end, and every step's noisy sequence, were x0 + slope (x - at) the clean ones."""

        def step(x, inputs):
            row, x0, at, slope = inputs
            clean = x0 + slope * (x - at)
            eps = (x - row.sqrt_alpha_bar * clean) / row.sqrt_one_minus_alpha_bar
            following = row.sqrt_alpha_bar_next * jnp.clip(clean, low, high)
            return following + row.sqrt_one_minus_alpha_bar_next * eps, x

        return jax.lax.scan(step, noise, (table, x0, at, slope), unroll=True)

    def evaluate(carry, _):
        _, x, x_before, x0_before = carry
        x0 = (x - spread * eps_fn(x, prepared)) / signal
        end, following = through(x0, x, _secant(x - x_before, x0 - x0_before, 1.0 / signal))
        return (end, following, x, x0), None

    x0 = jnp.zeros((steps, *noise.shape), noise.dtype)
    end, x = through(x0, x0, x0)
    (end, *_), _ = jax.lax.scan(evaluate, (end, x, x, x0), length=evaluations)
    return end


def _secant(dx: jax.Array, dx0: jax.Array, most: jax.Array) -> jax.Array:
    """Slope of each entry of a vector, over all times: 0 (of no noise) to `most` (of no signal)."""
    square = jnp.sum(dx * dx, axis=-2, keepdims=True)
    slope = jnp.sum(dx * dx0, axis=-2, keepdims=True) / jnp.maximum(square, _TINY)
    return jnp.clip(slope, 0.0, most)


def _beside(row: jax.Array) -> jax.Array:
    return row[:, None, None, None]
