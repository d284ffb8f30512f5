"""DDIM whose steps are computed side by side, in few evaluations of the network.

To predict the actions of a few robots a GPU reads every weight at every step, and that takes longer
than their arithmetic. So the network sees the sequences of all steps at once, as far as they are
known (Picard iteration; Shih et al., "Parallel Sampling of Diffusion Models", 2023), and after each
evaluation they are put together anew, each step's clean sequence being taken for a linear function
of its noisy one whose slope is that between the last two evaluations (a secant).

The fixed point of the iteration is the sequence of `diffusion.ddim_sample`; as many evaluations as
steps reach it with any network.
"""

import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from starjax.policies.models import diffusion, kernels
from starjax.policies.models import schedule as schedules

# So many evaluations for so many steps, and one more for twice as many, come equally near
# (benchmarks/bench_ddim.py).
_EVALUATIONS, _STEPS = 5, 10
# Number of sequences whose arithmetic takes a GPU as long as its constant work, mostly reading the
# weights: half of the measured one (an H100, preset `paper`: 32 robots took equally long either
# way, 16 took 15% less).
_WEIGHTS_IN_SEQUENCES = 128
_TINY = 1e-12  # squared distance of sequences that count as the same


def evaluations_for(steps: int) -> int:
    """Returns the number of evaluations of the network for so many steps."""
    return _EVALUATIONS + max(0, math.ceil(math.log2(steps / _STEPS)))


def pays(batch: int, steps: int) -> bool:
    """Returns whether so many robots' sequences take less time here than step by step."""
    beside = evaluations_for(steps) * (_WEIGHTS_IN_SEQUENCES + batch * steps)
    return kernels.on_gpu() and beside < steps * (_WEIGHTS_IN_SEQUENCES + batch)


def ddim_sample(
    eps_fn: Callable[[jax.Array, Any], jax.Array],
    noise: jax.Array,
    *,
    diffusion_steps: int = 100,
    steps: int = 10,
    evaluations: int | None = None,
    prepare: Callable[[jax.Array], Any] = lambda k: k,
    reach: Any = None,
) -> jax.Array:
    """Approximates `diffusion.ddim_sample`.

    Args:
      eps_fn: `(x [steps, B, H, A], prepared) -> eps [steps, B, H, A]`.
      noise: the start, standard normal `[B, H, A]`.
      diffusion_steps: K of the cosine schedule that the network was trained with.
      steps: n of DDIM.
      evaluations: of the network, with n sequences for each of B; None: `evaluations_for(n)`.
      prepare: maps the int32 steps `[n]` to a pytree with leading axis n, once; `eps_fn` gets it.
      reach: lowest and highest value, each broadcast against `[B, H, A]`; None: -1 and 1.

    Returns:
      Clean sequences `[B, H, A]` within `reach`.
    """
    table = schedules.ddim_table(diffusion_steps, steps)
    prepared = prepare(jnp.asarray(table.k))
    within = functools.partial(diffusion.within, reach=reach)
    signal, spread, signal_next, spread_next = (
        jnp.asarray(row)[:, None, None, None] for row in table[1:]
    )

    def through(x0: jax.Array, at: jax.Array, slope: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Returns the last and all noisy sequences, for clean ones x0 + slope (x - at)."""
        clipped = within(x0)
        # The clean sequence is affine in x, so each DDIM step is too: x' = factor x + rest. `gain`
        # is the derivative of x' by the clean sequence; if that is clipped, only through eps.
        gain = jnp.where(clipped == x0, signal_next, 0.0) - spread_next * signal / spread
        factor = spread_next / spread + gain * slope
        rest = signal_next * clipped - spread_next * signal / spread * x0 - gain * slope * at
        end, before = jax.lax.scan(
            lambda x, row: (row[0] * x + row[1], x), noise, (factor, rest), unroll=True
        )
        return within(end), before

    def evaluate(carry, _):
        _, x, x_before, x0_before = carry
        x0 = (x - spread * eps_fn(x, prepared)) / signal
        end, following = through(x0, x, _secant(x - x_before, x0 - x0_before, 1.0 / signal))
        return (end, following, x, x0), None

    x0 = jnp.zeros((steps, *noise.shape), noise.dtype)
    end, x = through(x0, x0, x0)
    (end, *_), _ = jax.lax.scan(
        evaluate, (end, x, x, x0), length=evaluations or evaluations_for(steps)
    )
    return end


def _secant(dx: jax.Array, dx0: jax.Array, most: jax.Array) -> jax.Array:
    """Returns the slope of each entry over all times: 0 (no noise) to `most` (no signal)."""
    square = jnp.sum(dx * dx, axis=-2, keepdims=True)
    slope = jnp.sum(dx * dx0, axis=-2, keepdims=True) / jnp.maximum(square, _TINY)
    return jnp.clip(slope, 0.0, most)
