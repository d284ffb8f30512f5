"""ResNet-18's trunk with GroupNorm: BatchNorm's running statistics break under weight averaging.

Names and shapes follow torchvision's, so that `pretrained` can fill in its ImageNet weights.
"""

import functools
import math
from collections.abc import Callable

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from starjax.models import layers

# Images up to which a GPU convolves as a matrix product. cuDNN's convolutions, started one by one
# between CUDA graphs, then take longer to start than to run: 0.35 ms of a call for one robot, which
# sees two frames.
_FEW = 2


class ResNet18(nn.Module):
    """Images to feature maps, 32 times smaller, `8 * width` channels.

    Attributes:
      width: channels of the stem, divisible by 16.
      dtype: of the arithmetic; parameters and statistics are float32.
    """

    width: int = 64
    dtype: jnp.dtype = jnp.float32

    @nn.compact
    def __call__(self, image: jax.Array) -> jax.Array:
        """`[N, h, w, 3]` normalised -> `[N, ceil(h/32), ceil(w/32), 8 width]`."""
        x = Stem(self.width, name="conv1")(image.astype(self.dtype))
        x = max_pool(nn.relu(group_norm("bn1", x)))
        for stage in range(4):
            for block in range(2):
                stride = 2 if stage > 0 and block == 0 else 1
                name = f"layer{stage + 1}_{block}"
                x = BasicBlock(self.width << stage, stride, name=name)(x)
        return x


class Stem(nn.Module):
    """7x7 convolution, stride 2, padding 3, without bias, over `[N, h, w, 3]`.

    Computed as a 4x4 convolution, stride 1, of 2x2 blocks of pixels: a GPU's matrix units need
    channels in eights, and three would be padded to them at full resolution.
    """

    features: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """`[N, h, w, 3] -> [N, ceil(h/2), ceil(w/2), features]`."""
        init = _kernel_init(7, self.features)
        kernel = self.param("kernel", init, (7, 7, x.shape[-1], self.features))
        # One more tap before the seven makes them four pairs: the padding before is then 4.
        kernel = jnp.pad(kernel.astype(x.dtype), ((1, 0), (1, 0), (0, 0), (0, 0)))
        pads = [(4, 2 * ((side + 1) // 2) + 2 - side) for side in x.shape[1:3]]
        blocks = _pairs(jnp.pad(x, ((0, 0), *pads, (0, 0))))
        kernel = jnp.moveaxis(_pairs(jnp.moveaxis(kernel, -1, 0)), 0, -1)
        return _convolve(blocks, kernel, 1, 0)


class BasicBlock(nn.Module):
    """Two 3x3 convolutions and a skip."""

    features: int
    stride: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """`[N, h, w, C] -> [N, ceil(h/stride), ceil(w/stride), features]`."""
        y = Conv2d(self.features, 3, self.stride, name="conv1")(x)
        y = nn.relu(group_norm("bn1", y))
        y = group_norm("bn2", Conv2d(self.features, 3, name="conv2")(y))
        if x.shape != y.shape:
            x = Conv2d(self.features, 1, self.stride, name="downsample_0")(x)
            x = group_norm("downsample_1", x)
        return nn.relu(x + y)


class Conv2d(nn.Module):
    """2-D convolution without bias, padding kernel_size // 2, over `[N, h, w, C]`."""

    features: int
    kernel_size: int
    stride: int = 1

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """`[N, h, w, C] -> [N, ceil(h/stride), ceil(w/stride), features]`."""
        size, pad = self.kernel_size, self.kernel_size // 2
        init = _kernel_init(size, self.features)
        kernel = self.param("kernel", init, (size, size, x.shape[-1], self.features))
        return _convolve(x, kernel.astype(x.dtype), self.stride, pad)


def group_norm(name: str, x: jax.Array) -> jax.Array:
    """GroupNorm with 16 channels a group, inside a compact module."""
    return layers.GroupNorm(x.shape[-1] // 16, name=name)(x)


@jax.custom_vjp
def max_pool(x: jax.Array) -> jax.Array:
    """3x3 maximum, stride 2, of values that are not negative: zero padding then changes nothing.

    Its gradient goes to the first of the largest, remembered as its number in the window: one pass
    over the output, where the gradient of maxima takes several over the input.
    """
    return _max_pool(x)[0]


def _max_pool(x: jax.Array) -> tuple[jax.Array, tuple[jax.Array, tuple[int, ...]]]:
    height, width = (x.shape[1] + 1) // 2, (x.shape[2] + 1) // 2
    padded = jnp.pad(x, ((0, 0), (1, 2), (1, 2), (0, 0)))
    largest = padded[:, : 2 * height : 2, : 2 * width : 2]
    number = jnp.zeros(largest.shape, jnp.uint8)
    for n in range(1, 9):
        i, j = divmod(n, 3)
        other = padded[:, i : i + 2 * height : 2, j : j + 2 * width : 2]
        number = jnp.where(other > largest, jnp.uint8(n), number)
        largest = jnp.maximum(largest, other)
    return largest, (number, x.shape)


def _max_pool_gradient(kept, g: jax.Array) -> tuple[jax.Array]:
    number, shape = kept
    # An even row is the middle of one window; an odd one the last of that and the first of the
    # next. Element-wise in the input's entries, so that it can be part of what uses it.
    row, column = (jnp.arange(side)[:, None] for side in shape[1:3])
    row, gradient = row[:, None], jnp.zeros(shape, g.dtype)
    for down, right in np.ndindex(2, 2):
        place = 3 * _place(row, down) + _place(column, right)
        chosen = _each_twice(number, down, right, shape) == place.astype(jnp.uint8)
        gradient += jnp.where(chosen, _each_twice(g, down, right, shape), 0)
    return (gradient,)


def _place(index: jax.Array, following: int) -> jax.Array:
    """Place (0 to 2) of an entry in its window, or in the following one; 9 if it is not in it."""
    return jnp.where(index % 2 == 0, 9 if following else 1, 0 if following else 2)


def _each_twice(x: jax.Array, down: int, right: int, shape: tuple[int, ...]) -> jax.Array:
    """`[N, h, w, C] -> shape`: for each entry its window's value, or that of a following one."""
    x = jnp.pad(x[:, down:, right:], ((0, 0), (0, down), (0, right), (0, 0)))
    batch, height, width, channels = x.shape
    twice = jnp.broadcast_to(x[:, :, None, :, None], (batch, height, 2, width, 2, channels))
    return twice.reshape(batch, 2 * height, 2 * width, channels)[:, : shape[1], : shape[2]]


max_pool.defvjp(_max_pool, _max_pool_gradient)


def _kernel_init(size: int, features: int) -> Callable[..., jax.Array]:
    """Variance 2 / fan-out, as torchvision's."""
    return layers.uniform_init(size * size * features, gain=math.sqrt(6.0))


def _convolve(x: jax.Array, kernel: jax.Array, stride: int, pad: int) -> jax.Array:
    """Convolution of `[N, h, w, C]` with `[size, size, C, features]`."""
    if len(x) > _FEW:
        return _convolution(x, kernel, stride, pad)
    product = functools.partial(_product, stride=stride, pad=pad)
    default = functools.partial(_convolution, stride=stride, pad=pad)
    return jax.lax.platform_dependent(x, kernel, cuda=product, default=default)


def _convolution(x: jax.Array, kernel: jax.Array, stride: int, pad: int) -> jax.Array:
    return jax.lax.conv_general_dilated(
        x,
        kernel,
        (stride, stride),
        [(pad, pad), (pad, pad)],
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
    )


def _product(x: jax.Array, kernel: jax.Array, stride: int, pad: int) -> jax.Array:
    """The same as one matrix product of the shifted inputs."""
    size = len(kernel)
    x = jnp.pad(x, ((0, 0), (pad, pad), (pad, pad), (0, 0)))
    down, right = ((side - size) // stride * stride + 1 for side in x.shape[1:3])
    shifted = [
        x[:, i : i + down : stride, j : j + right : stride] for i, j in np.ndindex(size, size)
    ]
    columns = jnp.concatenate(shifted, -1)
    if size == 1:
        # XLA would take the strided slice into the product's kernel, and abort the process where
        # its sides are odd (jaxlib 0.11, 29 pixels to 15).
        columns = jax.lax.optimization_barrier(columns)
    return columns @ kernel.reshape(-1, kernel.shape[-1])


def _pairs(x: jax.Array) -> jax.Array:
    """Blocks of 2x2 pixels as channels, filled up to a multiple of 8 with zeros.

    `[N, 2 h, 2 w, C] -> [N, h, w, 4 C rounded up]`.
    """
    batch, height, width, channels = x.shape
    x = x.reshape(batch, height // 2, 2, width // 2, 2, channels)
    x = jnp.moveaxis(x, 2, 3).reshape(batch, height // 2, width // 2, 4 * channels)
    return jnp.pad(x, ((0, 0), (0, 0), (0, 0), (0, -4 * channels % 8)))
