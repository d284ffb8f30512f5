"""Bias, GroupNorm and Mish of a 1-D convolution, on a GPU with one gradient for all three.

Differentiated one by one they read and write the gradient three times, in eight kernels, of which
half take a GPU longer to start than to run.
"""

import functools

import flax.linen as nn
import jax
import jax.numpy as jnp

from starjax.models import layers
from starjax.models.kernels import norms

Gradients = tuple[jax.Array, jax.Array, jax.Array, jax.Array]


class ActivatedNorm(nn.Module):
    """Mish of GroupNorm of a convolution's product and bias."""

    groups: int

    @nn.compact
    def __call__(self, product: jax.Array, bias: jax.Array) -> jax.Array:
        """`[B, L, C]`, `[C]` -> `[B, L, C]`."""
        scale, shift = norms.scale_and_shift(self, product, self.groups)
        return _jitted(product, bias, scale, shift, self.groups)


@functools.partial(jax.custom_vjp, nondiff_argnums=(4,))
def _activated(
    product: jax.Array, bias: jax.Array, scale: jax.Array, shift: jax.Array, groups: int
) -> jax.Array:
    return forward(product, bias, scale, shift, groups)[0]


def forward(
    product: jax.Array, bias: jax.Array, scale: jax.Array, shift: jax.Array, groups: int
) -> tuple[jax.Array, norms.Kept]:
    """What comes out, and what the gradients below need of it."""
    y, kept = norms.forward(product + bias.astype(product.dtype), scale, shift, groups)
    return layers.mish(y), kept


def _gradient(groups: int, kept: norms.Kept, g: jax.Array) -> Gradients:
    return (at_once if layers.on_gpu() else one_by_one)(groups, kept, g)


_activated.defvjp(forward, _gradient)
_jitted = jax.jit(_activated, static_argnums=4)  # traced once a shape


def one_by_one(groups: int, kept: norms.Kept, g: jax.Array) -> Gradients:
    """Gradients of product, bias, scale and shift as jax finds them."""

    def plain(x: jax.Array, scale: jax.Array, shift: jax.Array) -> jax.Array:
        return layers.mish(norms.group_norm(x, scale, shift, groups))

    by_x, by_scale, by_shift = jax.vjp(plain, kept.x, kept.scale, kept.shift)[1](g)
    return by_x, layers.sum_of_places(by_x).astype(jnp.float32), by_scale, by_shift


def at_once(groups: int, kept: norms.Kept, g: jax.Array) -> Gradients:
    """The same by way of two sums over positions."""
    z = norms.normalized(kept.x, *norms.kept_affine(kept, groups)).astype(jnp.float32)
    found = norms.gradient(kept, g.astype(jnp.float32) * _mish_slope(z), groups)
    of_samples = found.by_sum, found.by_scale, found.by_shift
    by_bias, by_scale, by_shift = norms.sums_of_samples(*of_samples)
    return found.by_x.astype(g.dtype), by_bias, by_scale, by_shift


def _mish_slope(z: jax.Array) -> jax.Array:
    e = jnp.exp(jnp.minimum(z, 20.0))
    n = e * (e + 2.0)
    over = 1.0 / (n + 2.0)
    return (n + 4.0 * z * e * (e + 1.0) * over) * over
