"""Layers that the networks share: Conv1d as one matrix product, Mish, Dense.

Parameters are float32; arithmetic runs in the dtype of the input (float32 or bfloat16). Initial
values follow torch's defaults, as Diffusion Policy's do.
"""

import functools
import math
from collections.abc import Callable
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike

from starjax.policies.models import kernels
from starjax.runtime import hashing


# Jitted inside of jitted programs: functions that many layers share are traced once per shape.
@jax.jit
def mish(x: jax.Array) -> jax.Array:
    """Computes x tanh(softplus(x)) by one exponential e = exp(x).

    tanh(log(1 + e)) = e (e + 2) / (e (e + 2) + 2).
    """
    wide = x.astype(jnp.float32)
    # Above 20 the ratio is 1 in float32; the clamp keeps the square from overflowing.
    e = jnp.exp(jnp.minimum(wide, 20.0))
    n = e * (e + 2.0)
    return (wide * (n / (n + 2.0))).astype(x.dtype)


@functools.partial(jax.jit, static_argnames="shape")
def spread(vector: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Broadcasts `[C]` to `shape` `[..., C]`; its gradient is summed in float32."""
    return _spread(vector, shape)


def _sum_of_positions(g: jax.Array) -> jax.Array:
    """Sums `[..., C]` to `[C]`."""
    reference = lambda g: jnp.sum(g, range(g.ndim - 1))  # noqa: E731
    return kernels.choose("sum_of_positions", reference)(g)


_spread: Any = jax.custom_vjp(jnp.broadcast_to, nondiff_argnums=(1,))
_spread.defvjp(
    lambda vector, shape: (jnp.broadcast_to(vector, shape), None),
    lambda shape, _, g: (_sum_of_positions(g),),
)


def uniform_init(fan_in: int, gain: float = 1.0) -> Callable[..., jax.Array]:
    """Draws uniformly within +-gain/sqrt(fan_in), hashed from the key and each entry's number.

    XLA on CPU takes over a second to compile each `jax.random` draw, and every parameter has its
    own: initialising the U-Net took 80 s. The hash compiles to a few integer operations.
    """
    bound = gain / math.sqrt(fan_in)

    return lambda key, shape: bound * _hashed(key, shape)


@functools.partial(jax.jit, static_argnames="shape")
def _hashed(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Draws uniformly in [-1, 1)."""
    bits = jnp.arange(math.prod(shape), dtype=jnp.uint32)
    for word in jax.random.key_data(key).ravel():
        bits = hashing.lowbias32(bits ^ word)
    return ((bits >> 8).astype(jnp.float32) * 2.0**-23 - 1.0).reshape(shape)


class Dense(nn.Module):
    """Affine map of the last axis. `zero` starts it as the zero map."""

    features: int
    zero: bool = False

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps `[..., C] -> [..., features]`."""
        init = uniform_init(x.shape[-1], gain=0.0 if self.zero else 1.0)
        kernel = self.param("kernel", init, (x.shape[-1], self.features))
        bias = self.param("bias", init, (self.features,))
        y = x @ kernel.astype(x.dtype)
        return y + spread(bias.astype(x.dtype), y.shape)


def xavier_init(
    key: jax.Array, shape: tuple[int, int], dtype: DTypeLike | None = None
) -> jax.Array:
    """Draws within +-sqrt(6 / (inputs + outputs)), hashed as in `uniform_init`, for attention."""
    return math.sqrt(6.0 / sum(shape)) * _hashed(key, tuple(shape))


def residual_mlp(x: jax.Array, width: int, blocks: int, dtype: DTypeLike) -> jax.Array:
    """Runs a residual MLP on `[..., C]`, in the scope of the module that calls it.

    Args:
      x: in `dtype`.
      width: of all layers.
      blocks: of LayerNorm, Linear, GELU, Linear.
      dtype: of the arithmetic; LayerNorm's is float32.

    Returns:
      `[..., width]`, in `dtype`.
    """
    x = Dense(width, name="project")(x)
    for _ in range(blocks):
        h = nn.LayerNorm()(x.astype(jnp.float32)).astype(dtype)
        h = nn.gelu(Dense(width)(h))
        x = x + Dense(width)(h)
    return x


class Conv1d(nn.Module):
    """1-D convolution over `[B, L, C]` as one matrix product of the shifted inputs.

    Taps that only ever meet the padding at this length are not made at all: at length 2 a kernel
    of 5 is exactly its centred 3, and the others would never get a gradient.
    """

    features: int
    kernel_size: int
    stride: int = 1
    padding: int | None = None  # on either side; None: kernel_size // 2

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps `[B, L, C] -> [B, (L + 2 padding - kernel_size) // stride + 1, features]`."""
        batch, length, channels = x.shape
        padding = self.kernel_size // 2 if self.padding is None else self.padding
        out = (length + 2 * padding - self.kernel_size) // self.stride + 1
        if out < 1:
            raise ValueError(
                f"x: expected a length that kernel {self.kernel_size} fits, got {length}"
            )
        taps = _live_taps(self.kernel_size, self.stride, padding, length, out)
        # The fan-in counts the dropped taps: initial values are distributed as with them.
        init = uniform_init(self.kernel_size * channels)
        kernel = self.param("kernel", init, (len(taps), channels, self.features))
        bias = self.param("bias", init, (self.features,))

        span = (out - 1) * self.stride + 1
        left = padding - taps[0]
        right = max(0, (out - 1) * self.stride + taps[-1] - padding - (length - 1))
        padded = jnp.pad(x, ((0, 0), (left, right), (0, 0)))
        shifted = [padded[:, j : j + span : self.stride] for j in range(len(taps))]
        stacked = jnp.concatenate(shifted, -1) if len(taps) > 1 else shifted[0]
        flat = stacked.reshape(batch * out, len(taps) * channels)
        y = flat @ kernel.astype(x.dtype).reshape(len(taps) * channels, self.features)
        y = y.reshape(batch, out, self.features)
        return y + spread(bias.astype(x.dtype), y.shape)


class Upsample1d(nn.Module):
    """Transposed convolution, kernel 4, stride 2, padding 1, as two products of one batch.

    With taps w0..w3, output 2i is x[i] w1 + x[i-1] w3 and output 2i + 1 is x[i] w2 + x[i+1] w0: the
    parameter holds w1 above w3, and w2 above w0.
    """

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps `[B, L, C] -> [B, 2 L, C]`."""
        batch, length, channels = x.shape
        init = uniform_init(4 * channels)
        kernel = self.param("kernel", init, (2, 2 * channels, channels)).astype(x.dtype)
        bias = self.param("bias", init, (channels,)).astype(x.dtype)
        before = jnp.pad(x, ((0, 0), (1, 0), (0, 0)))[:, :-1]
        after = jnp.pad(x, ((0, 0), (0, 1), (0, 0)))[:, 1:]
        pairs = jnp.stack([jnp.concatenate([x, other], -1) for other in (before, after)])
        y = jnp.matmul(pairs.reshape(2, batch * length, 2 * channels), kernel)
        y = jnp.moveaxis(y.reshape(2, batch, length, channels), 0, 2)
        shape = (batch, 2 * length, channels)
        return y.reshape(shape) + spread(bias, shape)


def _live_taps(kernel_size: int, stride: int, padding: int, length: int, out: int) -> range:
    """Returns the contiguous taps that meet the input at one output position at least."""
    live = [
        tap
        for tap in range(kernel_size)
        if any(0 <= i * stride + tap - padding < length for i in range(out))
    ]
    return range(live[0], live[-1] + 1)
