"""Sums over all positions of each channel, in two steps: the gradient of a bias.

Reference: `jnp.sum` over all axes but the last. On a GPU XLA adds up each channel from end to end,
with few threads: 0.1 ms for a bias where two steps take 0.01 ms.
"""

import math

import jax
import jax.numpy as jnp

from starjax.policies.models import kernels

_PARTS = 128  # partial sums of the first step, at most


def pays() -> bool:
    """Returns whether two steps are faster here."""
    return kernels.on_gpu()


def in_two_steps(g: jax.Array) -> jax.Array:
    """Sums `[..., C]` to `[C]` through at most `_PARTS` partial sums, `[B, C]` in one step."""
    dtype = g.dtype
    if g.ndim > 2:
        parts = math.gcd(math.prod(g.shape[:-1]), _PARTS)
        g = g.reshape(parts, -1, g.shape[-1]).sum(1, dtype=jnp.float32)
    # Without the barrier XLA merges the two sums again.
    return jax.lax.optimization_barrier(g).sum(0).astype(dtype)
