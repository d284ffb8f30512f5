"""Encodes observations: images to keypoints (Eq. 10), histories of measurements to a vector.

Both image encoders are a trunk, one map per keypoint, spatial softmax and a linear layer, and are
called alike. They see one image at a time.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from starjax.core.learners import ENCODERS
from starjax.policies.models import layers, resnet, spatial_softmax
from starjax.policies.models.group_norm import GroupNorm


class Trunk(NamedTuple):
    """Trunk of an image encoder.

    Attributes:
      make: (width, dtype, name=) -> flax module that maps `[N, h, w, 3]` normalised images to maps
        `[N, h', w', C]`.
      width: default channels of its first layer.
      cell: pixels per cell of its maps, along one side.
      encoder: flax module of the whole encoder, called as `ImageEncoder`, which None means.
      reads_depth: True if it reads views of depth, and nothing else.
    """

    make: Callable[..., nn.Module]
    width: int
    cell: int
    encoder: Callable[..., nn.Module] | None = None
    reads_depth: bool = False


class ImageEncoder(nn.Module):
    """Eq. 10: a frame to `features` numbers, half as many keypoints with two coordinates each.

    The paper's SpatialSoftmax(ResNet(I)) with d_v = 512 is read as 256 keypoints from a 1x1
    convolution, and a linear layer after it, which Diffusion Policy has too.

    Attributes:
      trunk: "resnet18" (GroupNorm), "small" (8 layers with the keypoints', for CPU), or that of
        another package.
      features: d_v, even.
      width: channels of the trunk's first layer, divisible by 16; 0: 64 for resnet18, 16 for small.
      dtype: of the trunk; spatial softmax, parameters and the output are float32.
    """

    trunk: str = "resnet18"
    features: int = 512
    width: int = 0
    dtype: jnp.dtype = jnp.float32

    @nn.compact
    def __call__(self, image: jax.Array, offset: jax.Array | None = None) -> jax.Array:
        """Maps normalised frames `[N, h, w, 3]` to float32 `[N, features]`.

        `offset` `[N, 2]` (row, column) is the crop's displacement from the centre crop in pixels,
        from `data.augment`; None means centre crops.
        """
        trunk = ENCODERS.get(self.trunk)
        maps = trunk.make(self.width or trunk.width, self.dtype, name="trunk")(image)
        if maps.shape[1] * maps.shape[2] == 1:
            raise ValueError(
                f"image: expected more than one cell after {self.trunk}, "
                f"got {image.shape[1]} x {image.shape[2]} pixels"
            )
        # Rounded logits would move a keypoint by a fraction of a cell, which is millimetres.
        kernel = self.param(
            "keypoints", layers.uniform_init(maps.shape[-1]), (maps.shape[-1], self.features // 2)
        )
        # [N, h, w, K]
        logits = jnp.matmul(maps, kernel.astype(maps.dtype), preferred_element_type=jnp.float32)
        points = spatial_softmax.spatial_softmax(logits, (image.shape[1], image.shape[2]), offset)
        # v_t (Eq. 10)
        return layers.Dense(self.features, name="out")(points.reshape(len(points), -1))


def make(name: str, **settings: Any) -> nn.Module:
    """Makes the encoder of a name, with attributes of `ImageEncoder`."""
    return (ENCODERS.get(name).encoder or ImageEncoder)(trunk=name, **settings)


class SmallTrunk(nn.Module):
    """Seven 3x3 convolutions to maps 8 times smaller, `4 * width` channels: an encoder for CPU."""

    width: int = 16
    dtype: jnp.dtype = jnp.float32

    @nn.compact
    def __call__(self, image: jax.Array) -> jax.Array:
        """Maps `[N, h, w, 3]` normalised -> `[N, ceil(h/8), ceil(w/8), 4 width]`."""
        x = image.astype(self.dtype)
        for doubling, stride in ((0, 2), (0, 1), (1, 2), (1, 1), (2, 2), (2, 1), (2, 1)):
            x = resnet.Conv2d(self.width << doubling, 3, stride)(x)
            # GroupNorm: statistics of a batch would differ between training and a single robot.
            x = nn.relu(GroupNorm(x.shape[-1] // 8)(x))
        return x


class StateEncoder(nn.Module):
    """Eq. 11: a history `[B, O, S]` to `[B, features]` by three 1-D convolutions.

    The third has the history's length and no padding, so it covers the whole history.
    """

    features: int = 256
    dtype: jnp.dtype = jnp.float32

    @nn.compact
    def __call__(self, history: jax.Array) -> jax.Array:
        """Returns float32 `[B, features]`; `history` normalised."""
        x = history.astype(self.dtype)
        x = layers.mish(layers.Conv1d(self.features // 4, 3)(x))
        x = layers.mish(layers.Conv1d(self.features // 2, 3)(x))
        x = layers.Conv1d(self.features, x.shape[1], padding=0)(x)
        return x[:, 0].astype(jnp.float32)  # s (Eq. 11): one position is left


RESNET18 = Trunk(resnet.ResNet18, 64, 32)
SMALL = Trunk(SmallTrunk, 16, 8)
