"""ResNet-18's trunk with GroupNorm: BatchNorm's running statistics break under weight averaging.

Names and shapes follow torchvision's: `pretrained` fills in its ImageNet weights.
"""

import math
from collections.abc import Callable

import flax.linen as nn
import jax
import jax.numpy as jnp

from starjax.policies.models import group_norm as norms
from starjax.policies.models import kernels, layers


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
        """Maps `[N, h, w, 3]` normalised -> `[N, ceil(h/32), ceil(w/32), 8 width]`."""
        x = Stem(self.width, name="conv1")(image.astype(self.dtype))
        size = math.ceil(image.shape[1] / 2), math.ceil(image.shape[2] / 2)
        norm = kernels.choose("NormReluPool", NormReluPool)
        x = norm(_groups(x), size, name="bn1")(x)
        for stage in range(4):
            for block in range(2):
                stride = 2 if stage > 0 and block == 0 else 1
                name = f"layer{stage + 1}_{block}"
                x = BasicBlock(self.width << stage, stride, name=name)(x)
        return x


class Stem(nn.Module):
    """7x7 convolution, stride 2, padding 3, without bias, over `[N, h, w, 3]`.

    Computed as a 4x2 convolution, stride 1, of blocks of 2x8 pixels, to all of a block's four
    outputs: a GPU's matrix units need channels in eights, and more than three of them.
    """

    features: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps `[N, h, w, 3] -> [N, ceil(h/4), 2, ceil(w/4), 2, features]` in pairs."""
        init = _kernel_init(7, self.features)
        kernel = self.param("kernel", init, (7, 7, x.shape[-1], self.features))
        height, width = x.shape[1:3]
        down, right = math.ceil(height / 4), math.ceil(width / 8)
        pads = ((0, 0), (4, 4 * down + 2 - height), (4, 8 * right + 4 - width), (0, 0))
        y = _convolve(_blocks(jnp.pad(x, pads)), _to_blocks(kernel.astype(x.dtype)), 1, 0)
        # A block's outputs side by side
        y = y.reshape(len(x), down, 2, 2 * right, 2, self.features)
        return y[:, :, :, : math.ceil(width / 4)]


class NormReluPool(nn.Module):
    """GroupNorm, ReLU, then the 3x3 maximum at stride 2, padding 1, of pairs of rows and columns.

    Attributes:
      groups: number of groups of channels.
      size: rows and columns of the input; where one is odd, the last pair is half filled.
    """

    groups: int
    size: tuple[int, int]

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps `[N, h, 2, w, 2, C] -> [N, h, w, C]`, from h pairs of rows and w of columns."""
        batch, rows, _, columns, _, channels = x.shape
        x = x.reshape(batch, 2 * rows, 2 * columns, channels)[:, : self.size[0], : self.size[1]]
        x = norms.group_norm(x, *norms.scale_and_shift(self, x, self.groups), self.groups)
        x = jnp.pad(
            nn.relu(x), ((0, 0), (1, 1), (1, 1), (0, 0))
        )  # zeros change no maximum of ReLUs
        return nn.max_pool(x, (3, 3), (2, 2))


class BasicBlock(nn.Module):
    """Two 3x3 convolutions and a skip."""

    features: int
    stride: int

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps `[N, h, w, C] -> [N, ceil(h/stride), ceil(w/stride), features]`."""
        y = Conv2d(self.features, 3, self.stride, name="conv1")(x)
        y = nn.relu(group_norm("bn1", y))
        y = group_norm("bn2", Conv2d(self.features, 3, name="conv2")(y))
        if x.shape != y.shape:  # where stride or width change: 1x1
            x = Conv2d(self.features, 1, self.stride, name="downsample_0")(x)
            x = group_norm("downsample_1", x)
        return _relu_of_sum(x, y)


class Conv2d(nn.Module):
    """2-D convolution without bias, padding kernel_size // 2, over `[N, h, w, C]`."""

    features: int
    kernel_size: int
    stride: int = 1

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """Maps `[N, h, w, C] -> [N, ceil(h/stride), ceil(w/stride), features]`."""
        size, pad = self.kernel_size, self.kernel_size // 2
        init = _kernel_init(size, self.features)
        kernel = self.param("kernel", init, (size, size, x.shape[-1], self.features))
        return _convolve(x, kernel.astype(x.dtype), self.stride, pad)


def group_norm(name: str, x: jax.Array) -> jax.Array:
    """Applies GroupNorm with 16 channels a group, inside a compact module."""
    return norms.GroupNorm(_groups(x), name=name)(x)


def _groups(x: jax.Array) -> int:
    return x.shape[-1] // 16


@jax.custom_vjp
def _relu_of_sum(x: jax.Array, y: jax.Array) -> jax.Array:
    """Returns the ReLU of x + y; its gradient reads the output, which is kept anyway."""
    return nn.relu(x + y)


def _relu_of_sum_forward(x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
    out = _relu_of_sum(x, y)
    return out, out


def _relu_of_sum_gradient(out: jax.Array, g: jax.Array) -> tuple[jax.Array, jax.Array]:
    # Without the barrier XLA computes the sum again.
    g = jnp.where(jax.lax.optimization_barrier(out) > 0, g, 0)
    return g, g


_relu_of_sum.defvjp(_relu_of_sum_forward, _relu_of_sum_gradient)


def _kernel_init(size: int, features: int) -> Callable[..., jax.Array]:
    """Draws with variance 2 / fan-out, as torchvision does."""
    return layers.uniform_init(size * size * features, gain=math.sqrt(6.0))


def convolve(x: jax.Array, kernel: jax.Array, stride: int, pad: int) -> jax.Array:
    """Convolves `[N, h, w, C]` with `[rows, columns, C, features]`, `pad` zeros on every side."""
    return jax.lax.conv_general_dilated(
        x,
        kernel,
        (stride, stride),
        [(pad, pad), (pad, pad)],
        dimension_numbers=("NHWC", "HWIO", "NHWC"),
    )


def _convolve(x: jax.Array, kernel: jax.Array, stride: int, pad: int) -> jax.Array:
    """Convolves as `convolve`, by the variant that is fastest here."""
    return kernels.choose("convolve", convolve, len(x))(x, kernel, stride, pad)


def _to_blocks(kernel: jax.Array) -> jax.Array:
    """Rewrites a kernel `[7, 7, C, F]` for `_blocks`: `[4, 2, 16 C, 4 F]`, four outputs a block."""
    rows, none = (1, 0), (0, 0)
    shifts = [(1 + 2 * output, 8 - 2 * output) for output in range(4)]
    wide = jnp.stack([jnp.pad(kernel, (rows, columns, none, none)) for columns in shifts], -2)
    _, _, channels, outputs, features = wide.shape
    wide = _blocks(wide.reshape(1, 8, 16, -1))
    return wide.reshape(4, 2, 16 * channels, outputs * features)


def _blocks(x: jax.Array) -> jax.Array:
    """Turns blocks of 2x8 pixels into channels: `[N, 2 h, 8 w, C] -> [N, h, w, 16 C]`."""
    batch, height, width, channels = x.shape
    x = x.reshape(batch, height // 2, 2, width // 8, 8, channels)
    return jnp.moveaxis(x, 2, 3).reshape(batch, height // 2, width // 8, -1)
