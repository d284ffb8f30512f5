"""ResNet-18's trunk with GroupNorm: BatchNorm's running statistics break under weight averaging.

Names and shapes follow torchvision's, so that `pretrained` can fill in its ImageNet weights.
"""

import math

import flax.linen as nn
import jax
import jax.numpy as jnp

from starjax.models import layers


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
        x = Conv2d(self.width, 7, 2, name="conv1")(image.astype(self.dtype))
        x = max_pool(nn.relu(group_norm("bn1", x)))
        for stage in range(4):
            for block in range(2):
                stride = 2 if stage > 0 and block == 0 else 1
                name = f"layer{stage + 1}_{block}"
                x = BasicBlock(self.width << stage, stride, name=name)(x)
        return x


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
        # Variance 2 / fan-out, as torchvision's.
        init = layers.uniform_init(size * size * self.features, gain=math.sqrt(6.0))
        kernel = self.param("kernel", init, (size, size, x.shape[-1], self.features))
        return jax.lax.conv_general_dilated(
            x,
            kernel.astype(x.dtype),
            (self.stride, self.stride),
            [(pad, pad), (pad, pad)],
            dimension_numbers=("NHWC", "HWIO", "NHWC"),
        )


def group_norm(name: str, x: jax.Array) -> jax.Array:
    """GroupNorm with 16 channels a group, inside a compact module."""
    return layers.GroupNorm(x.shape[-1] // 16, name=name)(x)


def max_pool(x: jax.Array) -> jax.Array:
    """3x3 maximum, stride 2, of values that are not negative: zero padding then changes nothing.

    Written as maxima of slices, whose gradient is cheaper than select-and-scatter.
    """
    height, width = (x.shape[1] + 1) // 2, (x.shape[2] + 1) // 2
    x = jnp.pad(x, ((0, 0), (1, 1), (1, 1), (0, 0)))
    rows = [x[:, i : i + 2 * height - 1 : 2] for i in range(3)]
    x = jnp.maximum(jnp.maximum(rows[0], rows[1]), rows[2])
    columns = [x[:, :, j : j + 2 * width - 1 : 2] for j in range(3)]
    return jnp.maximum(jnp.maximum(columns[0], columns[1]), columns[2])
