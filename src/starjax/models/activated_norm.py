"""Bias, GroupNorm and Mish of a 1-D convolution, on a GPU with one gradient for all three.

Differentiated one by one they read and write the gradient three times, in eight kernels, of which
half take a GPU longer to start than to run. What the three need are two sums over positions, of the
gradient before Mish and of that times x; the rest is arithmetic of `[B, C]`.
"""

import functools
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from starjax.models import layers

Gradients = tuple[jax.Array, jax.Array, jax.Array, jax.Array]


class ActivatedNorm(nn.Module):
    """Mish of GroupNorm of a convolution's product and bias."""

    groups: int

    @nn.compact
    def __call__(self, product: jax.Array, bias: jax.Array) -> jax.Array:
        """`[B, L, C]`, `[C]` -> `[B, L, C]`."""
        scale, shift = layers.scale_and_bias(self, product, self.groups)
        return _jitted(product, bias, scale, shift, self.groups)


class Kept(NamedTuple):
    """Of the forward pass.

    Attributes:
      x: `[B, L, C]` with the bias.
      scale: `[C]`, GroupNorm's, as `shift`.
      shift: `[C]`.
      mean: float32 `[B, C]` of each channel.
      square: float32 `[B, C]`, of its squares.
    """

    x: jax.Array
    scale: jax.Array
    shift: jax.Array
    mean: jax.Array
    square: jax.Array


@functools.partial(jax.custom_vjp, nondiff_argnums=(4,))
def _activated(
    product: jax.Array, bias: jax.Array, scale: jax.Array, shift: jax.Array, groups: int
) -> jax.Array:
    return forward(product, bias, scale, shift, groups)[0]


def forward(
    product: jax.Array, bias: jax.Array, scale: jax.Array, shift: jax.Array, groups: int
) -> tuple[jax.Array, Kept]:
    """What comes out, and what the gradients below need of it."""
    x = product + bias.astype(product.dtype)
    moments = layers.moments(x)
    normalized = layers.normalized(x, *layers.affine(*moments, scale, shift, groups))
    return layers.mish(normalized), Kept(x, scale, shift, *moments)


def _gradient(groups: int, kept: Kept, g: jax.Array) -> Gradients:
    ours, default = (functools.partial(f, groups) for f in (at_once, one_by_one))
    return jax.lax.platform_dependent(kept, g, cuda=ours, default=default)


_activated.defvjp(forward, _gradient)
_jitted = jax.jit(_activated, static_argnums=4)  # traced once a shape


def one_by_one(groups: int, kept: Kept, g: jax.Array) -> Gradients:
    """Gradients of product, bias, scale and shift as jax finds them."""

    def plain(x: jax.Array, scale: jax.Array, shift: jax.Array) -> jax.Array:
        return layers.mish(layers.group_norm(x, scale, shift, groups))

    by_x, by_scale, by_shift = jax.vjp(plain, kept.x, kept.scale, kept.shift)[1](g)
    return by_x, layers.sum_of_places(by_x).astype(jnp.float32), by_scale, by_shift


def at_once(groups: int, kept: Kept, g: jax.Array) -> Gradients:
    """The same by way of two sums over positions."""
    _, length, channels = kept.x.shape
    wide = functools.partial(layers.each, channels=channels)
    mean, inverse = layers.of_groups(kept.mean, kept.square, groups)
    gain, shift = layers.affine(kept.mean, kept.square, kept.scale, kept.shift, groups)
    z = layers.normalized(kept.x, gain, shift).astype(jnp.float32)
    x, by_z = kept.x.astype(jnp.float32), g.astype(jnp.float32) * _mish_slope(z)
    # of the loss by shift, and by gain, if each sample and channel had its own
    by_shift, by_gain = by_z.sum(1), (by_z * x).sum(1)

    # By each group's mean of squares and by its mean, through gain and shift. The variance is not
    # clipped here: where it is, a group of equal numbers, its gradient is rounding anyway.
    weighted, weighted_x = (
        (by * kept.scale).reshape(len(x), groups, -1).sum(-1) for by in (by_shift, by_gain)
    )
    by_square = -0.5 * inverse**3 * (weighted_x - mean * weighted)
    by_mean = -inverse * weighted - 2.0 * mean * by_square
    entries = length * channels // groups
    constant, linear = wide(by_mean / entries), wide(2.0 * by_square / entries)
    by_x = by_z * gain[:, None] + constant[:, None] + linear[:, None] * x

    by_bias = by_shift * gain + length * (constant + linear * kept.mean)
    by_scale = wide(inverse) * (by_gain - wide(mean) * by_shift)
    sums = layers.sum_in_two(jnp.concatenate([by_bias, by_scale, by_shift], axis=1))
    by_bias, by_scale, by_shift = jnp.split(sums, 3)
    return by_x.astype(g.dtype), by_bias, by_scale, by_shift


def _mish_slope(z: jax.Array) -> jax.Array:
    e = jnp.exp(jnp.minimum(z, 20.0))
    n = e * (e + 2.0)
    over = 1.0 / (n + 2.0)
    return (n + 4.0 * z * e * (e + 1.0) * over) * over
