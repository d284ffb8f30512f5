"""GroupNorm, with statistics in float32 for inputs of any type."""

import functools
import math

import flax.linen as nn
import jax
import jax.numpy as jnp

from starjax.policies.models import layers

EPSILON = 1e-5  # torch's default


class GroupNorm(nn.Module):
    """Normalises each sample over groups of channels and all positions."""

    groups: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps `[B, ..., C] -> [B, ..., C]`."""
        return group_norm(x, *scale_and_shift(self, x, self.groups), self.groups)


def scale_and_shift(module: nn.Module, x: jax.Array, groups: int) -> tuple[jax.Array, jax.Array]:
    """Declares the parameters `[C]` of a module that normalises `x` `[B, ..., C]`.

    Call it in the module's compact method.
    """
    channels = x.shape[-1]
    if channels % groups:
        raise ValueError(f"groups: expected a divisor of {channels} channels, got {groups}")
    scale = module.param("scale", nn.initializers.ones, (channels,), jnp.float32)
    return scale, module.param("bias", nn.initializers.zeros, (channels,), jnp.float32)


@functools.partial(jax.jit, static_argnames="groups")  # traced once a shape
def group_norm(x: jax.Array, scale: jax.Array, shift: jax.Array, groups: int) -> jax.Array:
    """Normalises `[B, ..., C]`, then scales and shifts each channel by `[C]`."""
    # Positions first, channels after: both reductions then run along contiguous memory,
    # followed by one multiply-add per element.
    wide = x.astype(jnp.float32)  # once: its gradient is summed before it is rounded
    return normalized(wide, *affine(*moments(wide), scale, shift, groups)).astype(x.dtype)


def moments(x: jax.Array, entries: int | None = None) -> tuple[jax.Array, jax.Array]:
    """Returns means of `[B, ..., C]` and of its squares over positions, each `[B, C]` float32.

    `entries` is how many positions count where the others are zero.
    """
    wide = x.astype(jnp.float32)
    entries = math.prod(x.shape[1:-1]) if entries is None else entries
    positions = tuple(range(1, x.ndim - 1))
    return wide.sum(positions) / entries, (wide * wide).sum(positions) / entries  # E[x], E[x^2]


def affine(
    mean: jax.Array, square: jax.Array, scale: jax.Array, shift: jax.Array, groups: int
) -> tuple[jax.Array, jax.Array]:
    """Returns the gain and offset `[B, C]` that normalise samples of these `moments`."""
    shape = mean.shape
    mean, square = (m.reshape(len(m), groups, -1).mean(-1) for m in (mean, square))
    # 1 / sqrt(E[x^2] - E[x]^2)
    inverse = jax.lax.rsqrt(jnp.maximum(square - mean * mean, 0.0) + EPSILON)
    mean, inverse = (jnp.repeat(m, shape[1] // groups, axis=1) for m in (mean, inverse))
    gain = inverse * layers.spread(scale, shape)
    return gain, layers.spread(shift, shape) - mean * gain  # y = gain x + (shift - gain mean)


def normalized(x: jax.Array, gain: jax.Array, offset: jax.Array) -> jax.Array:
    """Returns `[B, ..., C]` times gain plus offset, `[B, C]` each."""
    y = x.astype(jnp.float32) * over_positions(gain, x) + over_positions(offset, x)
    return y.astype(x.dtype)


def over_positions(vector: jax.Array, x: jax.Array) -> jax.Array:
    """Adds to `[B, C]` the axes that broadcast against `[B, ..., C]`."""
    return jnp.expand_dims(vector, tuple(range(1, x.ndim - 1)))
