"""Spatial softmax: the expected image position of each feature map (part of Eq. 10)."""

import jax
import jax.numpy as jnp


def spatial_softmax(
    logits: jax.Array, image_size: tuple[int, int], offset: jax.Array | None = None
) -> jax.Array:
    """Returns the expected coordinate under the softmax of each map, in float32.

    The unit is half the image's side and the origin its centre, so an image that is not shifted
    spans [-1, 1]. A cell counts as the centre of the pixels it covers.

    Args:
      logits: `[N, h, w, K]`.
      image_size: height and width in pixels of the image that the maps came from.
      offset: `[N, 2]` pixels (row, column) by which that image was cut away from the centre crop.
        With it, coordinates are those of the uncropped image, and a random crop of a whole number
        of cells moves no keypoint. In other crops the last cell extends past the edge, cells are
        taken as narrower, and that fraction of the offset remains: 4% (115 px in cells of 8) to 10%
        (230 px in cells of 32).

    Returns:
      float32 `[N, K, 2]`, (row, column).
    """
    n, height, width, maps = logits.shape
    weights = jax.nn.softmax(logits.astype(jnp.float32).reshape(n, height * width, maps), axis=1)
    weights = weights.reshape(n, height, width, maps)
    # Two small sums instead of one product with a [h w, 2] table: nothing here may be rounded to
    # a matrix unit's low precision, 1 mm of board is about 0.01 in these units.
    row = (weights.sum(2) * _centres(height)[None, :, None]).sum(1)  # E[row] = sum_i p(i) centre_i
    column = (weights.sum(1) * _centres(width)[None, :, None]).sum(1)
    points = jnp.stack([row, column], -1)
    if offset is None:
        return points
    half = jnp.array([image_size], jnp.float32) / 2
    # Back to the uncropped image: a random crop must not move the policy's keypoints.
    return points + (offset.astype(jnp.float32) / half)[:, None, :]


def _centres(cells: int) -> jax.Array:
    """Returns `[cells]` centres of equal cells that tile [-1, 1]."""
    return (2.0 * jnp.arange(cells, dtype=jnp.float32) + 1.0) / cells - 1.0
