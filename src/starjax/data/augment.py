"""Image augmentation on the device: crop, colour jitter, noise and normalisation in one pass.

All of it is element-wise after the crop, so the compiler reads the uint8 frames once and writes the
network's input once. The noise comes from hashing the pixel's number, not from a random-number
array that would have to be written and read.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np

from starjax.runtime import hashing

# Statistics of ImageNet, which the pretrained encoder expects; good enough from scratch.
MEAN = (0.485, 0.456, 0.406)
STD = (0.229, 0.224, 0.225)
LUMINANCE = (0.299, 0.587, 0.114)


def augment(
    key: jax.Array,
    images: jax.Array,
    *,
    crop: int,
    jitter: float | np.ndarray = 0.1,
    noise: float | np.ndarray = 0.02,
    dtype: jnp.dtype = jnp.float32,
) -> tuple[jax.Array, jax.Array]:
    """Applies random crop, colour jitter and Gaussian noise, drawn anew for each frame.

    Contrast turns about mid-grey, not about the frame's mean, and values are clipped once at the
    end: both spare a pass over the frames.

    Args:
      key: one typed key for the whole batch.
      images: uint8 `[..., h, w, 3]`.
      crop: side of the crop in pixels.
      jitter: brightness, contrast and saturation factors are uniform within 1 +- this; `[K]` for
        images `[..., K, h, w, 3]` of K cameras.
      noise: standard deviation, of values in [0, 1]; one or `[K]`, as `jitter`.
      dtype: of the result.

    Returns:
      Normalised frames `[..., crop, crop, 3]`, and the float32 `[..., 2]` displacement (row,
      column) in pixels of each crop from the centre crop, for the encoder.
    """
    lead, (height, width) = images.shape[:-3], _check(images, crop)
    frames = images.reshape((-1, height, width, 3))
    # One draw for all: each would cost XLA on CPU a second of compilation.
    bits = jax.random.bits(key, (len(frames), 6), jnp.uint32)
    # Places of the crop's corner
    spans = jnp.array([height - crop + 1, width - crop + 1], jnp.uint32)
    corner = (bits[:, :2] % spans).astype(jnp.int32)  # biased by 2^-32 spans: nothing
    if np.ndim(jitter):
        jitter = np.broadcast_to(jitter, lead).reshape(-1, 1)
    if np.ndim(noise):
        noise = np.broadcast_to(noise, lead).reshape(-1, 1, 1, 1)
    # 24 bits make a float32 in [0, 2): factors are uniform in 1 +- jitter.
    factors = 1.0 + jitter * ((bits[:, 2:5] >> 8).astype(jnp.float32) * 2.0**-23 - 1.0)
    x = jax.vmap(lambda f, c: jax.lax.dynamic_slice(f, (c[0], c[1], 0), (crop, crop, 3)))(
        frames, corner
    )
    x = _jitter(x.astype(jnp.float32) / 255.0, *factors.T)
    x = jnp.clip(x + noise * hash_normal(bits[:, 5], x.shape[1:]), 0.0, 1.0)
    offset = (corner - jnp.array(_centre(height, width, crop))).astype(jnp.float32)
    return _normalize(x, dtype).reshape((*lead, crop, crop, 3)), offset.reshape((*lead, 2))


def center(images: jax.Array, *, crop: int, dtype: jnp.dtype = jnp.float32) -> jax.Array:
    """Crops at the centre and normalises: uint8 `[..., h, w, 3] -> [..., c, c, 3]`."""
    top, left = _centre(*_check(images, crop), crop)
    x = images[..., top : top + crop, left : left + crop, :]
    return _normalize(x.astype(jnp.float32) / 255.0, dtype)


def hash_normal(seed: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Draws nearly normal noise (mean 0, deviation 1) with a few integer operations per value.

    Each value is the sum of the four bytes of a hashed counter (Irwin-Hall: within +-3.5, excess
    kurtosis -0.3): good enough for pixels, not for sampling from a model.

    Args:
      seed: random uint32 `[N]`.
      shape: of one frame.

    Returns:
      float32 `[N, *shape]`.
    """
    # Same for all frames
    counter = hashing.lowbias32(jnp.arange(math.prod(shape), dtype=jnp.uint32))
    bits = hashing.lowbias32(seed[:, None] ^ counter)
    low, high = bits & 0x00FF00FF, (bits >> 8) & 0x00FF00FF  # two bytes each, in 16-bit lanes
    pairs = low + high
    total = (pairs & 0xFFFF) + (pairs >> 16)
    deviation = ((256.0**2 - 1.0) / 3.0) ** 0.5  # 4 bytes of variance (256^2 - 1) / 12
    return ((total.astype(jnp.float32) - 510.0) / deviation).reshape((-1, *shape))


def _jitter(x: jax.Array, brightness: jax.Array, contrast: jax.Array, saturation: jax.Array):
    """Scales the colours of `[N, c, c, 3]` in [0, 1] by factors `[N]`, without clipping."""
    brightness, contrast, saturation = (
        factor[:, None, None, None] for factor in (brightness, contrast, saturation)
    )
    x = (x * brightness - 0.5) * contrast + 0.5  # about mid-grey
    grey = sum(weight * x[..., i : i + 1] for i, weight in enumerate(LUMINANCE))
    return grey + (x - grey) * saturation  # 0: grey, 1: unchanged


def _normalize(x: jax.Array, dtype: jnp.dtype) -> jax.Array:
    return ((x - jnp.array(MEAN)) / jnp.array(STD)).astype(dtype)


def _centre(height: int, width: int, crop: int) -> tuple[int, int]:
    return (height - crop) // 2, (width - crop) // 2


def _check(images: jax.Array, crop: int) -> tuple[int, int]:
    """Returns height and width; raises if `images` is not uint8 or smaller than the crop."""
    if images.ndim < 3 or images.shape[-1] != 3 or images.dtype != jnp.uint8:
        raise ValueError(
            f"images: expected uint8 [..., h, w, 3], got {images.dtype} {images.shape}"
        )
    height, width = images.shape[-3:-1]
    if not 1 <= crop <= min(height, width):
        raise ValueError(f"crop: expected 1..{min(height, width)} pixels, got {crop}")
    return height, width
