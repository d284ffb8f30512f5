"""GroupNorm, whose statistics are always float32, and on a GPU its gradient at once."""

import functools
import math
from typing import NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from starjax.models import layers

EPSILON = 1e-5  # torch's default
# Positions of an image, and a row's, that a GPU adds up one by one: XLA's sums over so few leave
# most of a block's threads waiting (7x7: 31 us for 5).
_IMAGE = 49
_ROW = 14


class GroupNorm(nn.Module):
    """Normalise each sample over groups of channels and all positions."""

    groups: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """`[B, ..., C] -> [B, ..., C]`."""
        return group_norm(x, *scale_and_shift(self, x, self.groups), self.groups)


class Kept(NamedTuple):
    """What a gradient needs of the forward pass.

    Attributes:
      x: `[B, ..., C]`, what was normalised.
      scale: `[C]`, as `shift`.
      shift: `[C]`.
      mean: float32 `[B, C]` of each channel.
      square: float32 `[B, C]`, of its squares.
    """

    x: jax.Array
    scale: jax.Array
    shift: jax.Array
    mean: jax.Array
    square: jax.Array


class Gradient(NamedTuple):
    """Of the loss, all float32.

    Attributes:
      by_x: `[B, ..., C]`.
      by_scale: `[B, C]`, of each sample, as `by_shift`.
      by_shift: `[B, C]`.
      by_sum: `[B, C]`, `by_x` summed up over positions.
    """

    by_x: jax.Array
    by_scale: jax.Array
    by_shift: jax.Array
    by_sum: jax.Array


def scale_and_shift(module: nn.Module, x: jax.Array, groups: int) -> tuple[jax.Array, jax.Array]:
    """Parameters `[C]` of a module that normalises `x` `[B, ..., C]`, in its compact method."""
    channels = x.shape[-1]
    if channels % groups:
        raise ValueError(f"groups: expected a divisor of {channels} channels, got {groups}")
    scale = module.param("scale", nn.initializers.ones, (channels,))
    return scale, module.param("bias", nn.initializers.zeros, (channels,))


@functools.partial(jax.jit, static_argnames="groups")  # traced once a shape
def group_norm(x: jax.Array, scale: jax.Array, shift: jax.Array, groups: int) -> jax.Array:
    """What `GroupNorm` does with its parameters `[C]`."""
    # as jax differentiates it on a CPU, where trainings keep their bits
    return _at_once(x, scale, shift, groups) if layers.on_gpu() else _plain(x, scale, shift, groups)


def _plain(x: jax.Array, scale: jax.Array, shift: jax.Array, groups: int) -> jax.Array:
    return forward(x, scale, shift, groups)[0]


def forward(
    x: jax.Array, scale: jax.Array, shift: jax.Array, groups: int
) -> tuple[jax.Array, Kept]:
    """What comes out, and what `gradient` needs of it."""
    # Positions first, channels after: both reductions then run along contiguous memory, and
    # what remains is one multiply-add for each element.
    kept = Kept(x, scale, shift, *moments(x))
    return normalized(x, *kept_affine(kept, groups)), kept


def gradient(kept: Kept, by_z: jax.Array, groups: int) -> Gradient:
    """By way of two sums over positions, given float32 `by_z` of what came out."""
    channels = kept.x.shape[-1]
    wide = functools.partial(each, channels=channels)
    mean, inverse = of_groups(kept.mean, kept.square, groups)
    gain, _ = kept_affine(kept, groups)
    x = kept.x.astype(jnp.float32)
    # of the loss by shift, and by gain, if each sample and channel had its own
    by_shift, by_gain = sums(by_z, by_z * x)

    # By each group's mean of squares and by its mean, through gain and shift. The variance is not
    # clipped here: where it is, a group of equal numbers, its gradient is rounding anyway.
    weighted, weighted_x = (
        (by * kept.scale).reshape(len(x), groups, -1).sum(-1) for by in (by_shift, by_gain)
    )
    by_square = -0.5 * inverse**3 * (weighted_x - mean * weighted)
    by_mean = -inverse * weighted - 2.0 * mean * by_square
    positions = math.prod(x.shape[1:-1])
    entries = positions * channels // groups
    constant, linear = wide(by_mean / entries), wide(2.0 * by_square / entries)
    return Gradient(
        by_x=by_z * beside(gain, x) + beside(constant, x) + beside(linear, x) * x,
        by_scale=wide(inverse) * (by_gain - wide(mean) * by_shift),
        by_shift=by_shift,
        by_sum=by_shift * gain + positions * (constant + linear * kept.mean),
    )


def _gradient(groups: int, kept: Kept, g: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    found = gradient(kept, g.astype(jnp.float32), groups)
    by_scale, by_shift = sums_of_samples(found.by_scale, found.by_shift)
    return found.by_x.astype(g.dtype), by_scale, by_shift


_at_once = jax.custom_vjp(_plain, nondiff_argnums=(3,))
_at_once.defvjp(forward, _gradient)


def sums_of_samples(*vectors: jax.Array) -> list[jax.Array]:
    """`[B, C]` each -> `[C]` each."""
    return jnp.split(layers.sum_in_two(jnp.concatenate(vectors, axis=1)), len(vectors))


def moments(x: jax.Array, entries: int | None = None) -> tuple[jax.Array, jax.Array]:
    """Means of `[B, ..., C]` and of its squares over positions, each `[B, C]` float32.

    `entries`: how many positions count, if the others are zeros.
    """
    wide = x.astype(jnp.float32)
    entries = math.prod(x.shape[1:-1]) if entries is None else entries
    if layers.on_gpu():
        total, squares = sums(wide, wide * wide)
        return total / entries, squares / entries
    # One after the other: another order of operations, and a CPU's trainings have other bits.
    positions = tuple(range(1, x.ndim - 1))
    return wide.sum(positions) / entries, (wide * wide).sum(positions) / entries


def sums(*arrays: jax.Array) -> tuple[jax.Array, ...]:
    """`[B, ..., C]` each -> `[B, C]` each, over positions, on a GPU."""
    if arrays[0].ndim == 4:
        batch, height, width, channels = arrays[0].shape
        if height * width <= _IMAGE:
            shape = (batch, height * width, channels)
            found = tuple(_one_by_one(x.reshape(shape), 1) for x in arrays)
            return jax.lax.optimization_barrier(found)  # or each of its uses would add up again
        if width <= _ROW:
            arrays = jax.lax.optimization_barrier(tuple(_one_by_one(x, 2) for x in arrays))
    return tuple(x.sum(tuple(range(1, x.ndim - 1))) for x in arrays)


def _one_by_one(x: jax.Array, axis: int) -> jax.Array:
    slices = jax.lax.split(x, (1,) * x.shape[axis], axis)
    return functools.reduce(jnp.add, slices).squeeze(axis)


def kept_affine(kept: Kept, groups: int) -> tuple[jax.Array, jax.Array]:
    """`affine` of the forward pass."""
    return affine(kept.mean, kept.square, kept.scale, kept.shift, groups)


def affine(
    mean: jax.Array, square: jax.Array, scale: jax.Array, shift: jax.Array, groups: int
) -> tuple[jax.Array, jax.Array]:
    """Gain and shift `[B, C]` by which a sample of these moments is normalised over groups."""
    shape = mean.shape
    mean, inverse = of_groups(mean, square, groups)
    gain = each(inverse, shape[1]) * layers.spread(scale, shape)
    return gain, layers.spread(shift, shape) - each(mean, shape[1]) * gain


def of_groups(mean: jax.Array, square: jax.Array, groups: int) -> tuple[jax.Array, jax.Array]:
    """Mean and one over the standard deviation of groups, `[B, G]`, from moments `[B, C]`."""
    mean, square = (m.reshape(len(m), groups, -1).mean(-1) for m in (mean, square))
    return mean, jax.lax.rsqrt(jnp.maximum(square - mean * mean, 0.0) + EPSILON)


def each(group: jax.Array, channels: int) -> jax.Array:
    """`[B, G] -> [B, C]`: of each channel's group."""
    return jnp.repeat(group, channels // group.shape[1], axis=1)


def normalized(x: jax.Array, gain: jax.Array, shift: jax.Array) -> jax.Array:
    """`[B, ..., C]` times gain plus shift, `[B, C]` each."""
    return (x.astype(jnp.float32) * beside(gain, x) + beside(shift, x)).astype(x.dtype)


def beside(vector: jax.Array, x: jax.Array) -> jax.Array:
    """`[B, C]` beside `[B, ..., C]`."""
    return jnp.expand_dims(vector, tuple(range(1, x.ndim - 1)))
