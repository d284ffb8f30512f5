"""An encoder of depth views as point clouds: PointNet's features, and keypoints in space.

Each cell of a depth image gives one point by back-projection. As in PointNet (Qi et al. 2017), one
network reads every point, and the maximum over all of them describes the cloud. The points are
weighted by a softmax per keypoint, as cells are by the spatial softmax of images.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp

from starjax.data import augment
from starjax.policies.models import layers
from starjax.policies.models.encoders import Trunk
from starjax.sim import derived_views

_CENTRE = 0.35  # m, middle of the depths of a view
_UNIT = 0.1  # m, half a workspace: points are of order one


class PointTrunk(nn.Module):
    """Reads every point alone, then with the maximum over all of them."""

    width: int = 32
    dtype: jnp.dtype = jnp.float32

    @nn.compact
    def __call__(self, points: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Maps `[N, P, 3]` to features of the points `[N, P, 4 width]` and of the cloud."""
        x = points.astype(self.dtype)
        for width in (self.width, 2 * self.width, 4 * self.width):
            x = nn.relu(layers.Dense(width)(x))
        cloud = x.max(axis=1)
        x = layers.Dense(4 * self.width)(x) + layers.Dense(4 * self.width)(cloud)[:, None]
        return nn.relu(x), cloud


class PointEncoder(nn.Module):
    """A depth view to `features` numbers, called as `models.encoders.ImageEncoder` is.

    Attributes:
      trunk: its name in `learners.ENCODERS`.
      features: d_v, four for each keypoint.
      width: of the trunk's first layer; 0: 32.
      dtype: of the trunk; points, softmax, parameters and the output are float32.
    """

    trunk: str = "points"
    features: int = 512
    width: int = 0
    dtype: jnp.dtype = jnp.float32

    @nn.compact
    def __call__(self, image: jax.Array, offset: jax.Array | None = None) -> jax.Array:
        """Maps normalised depth views `[N, h, w, 3]` to float32 `[N, features]`.

        `offset` `[N, 2]` as for `ImageEncoder`.
        """
        points = back_projected(image, offset)
        read, cloud = PointTrunk(self.width or POINTS.width, self.dtype, name="trunk")(points)
        kernel = self.param(
            "keypoints", layers.uniform_init(read.shape[-1]), (read.shape[-1], self.features // 4)
        )
        logits = jnp.matmul(read, kernel.astype(read.dtype), preferred_element_type=jnp.float32)
        weights = jax.nn.softmax(logits, axis=1)
        # Not a matrix product: none of a point's digits may be rounded away.
        keypoints = jnp.stack([(weights * points[..., i : i + 1]).sum(1) for i in range(3)], -1)
        found = [keypoints.reshape(len(image), -1), cloud.astype(jnp.float32)]
        return layers.Dense(self.features, name="out")(jnp.concatenate(found, axis=-1))


def back_projected(image: jax.Array, offset: jax.Array | None = None) -> jax.Array:
    """Returns the points `[N, P, 3]` (row, column, depth) of normalised depth views `[N, h, w, 3]`.

    A point is that of the pixel in the middle of its cell. Depths are in units of 10 cm from the
    middle of the range. Rows and columns are the ray's, in half images from the centre of the
    centre crop, times the depth in the same unit: those of the camera's frame apart from its focal
    length and principal point, two linear maps that the first layer can learn.
    """
    half, cell = image.shape[1] / 2, POINTS.cell
    middle = jnp.arange(cell // 2, image.shape[1], cell)
    cells = image[:, cell // 2 :: cell, cell // 2 :: cell].astype(jnp.float32)
    scaled = cells * jnp.array(augment.STD) + jnp.array(augment.MEAN)
    depth = derived_views.decode_scaled(scaled, jnp)
    rays = (middle + 0.5) / half - 1.0
    moved = jnp.zeros((len(image), 2)) if offset is None else offset.astype(jnp.float32) / half
    row, column = rays[None, :, None] + moved[:, :1, None], rays[None, None] + moved[:, 1:, None]
    points = jnp.stack([row * depth, column * depth, depth - _CENTRE], axis=-1) / _UNIT
    return points.reshape(len(image), -1, 3)


POINTS = Trunk(PointTrunk, width=32, cell=2, encoder=PointEncoder, reads_depth=True)
