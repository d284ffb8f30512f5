"""Images of other sizes and types as a policy observes them, as openpi's image tools do."""

import numpy as np
from PIL import Image

from starjax.core.errors import UsageError

LARGEST = (480, 640)  # pixels of an image of a request, as 4-byte numbers


def adapt(name: str, images: np.ndarray, size: int, moments: int) -> np.ndarray:
    """Returns an image `[size, size, 3]` uint8, or those of O moments `[O, size, size, 3]`.

    Floats in [0, 1] are multiplied by 255 and rounded. Other sizes are scaled bilinearly with their
    ratio of sides kept, and padded with black on both sides.

    Args:
      name: of the images, for errors.
      images: `[h, w, 3]` or `[O, h, w, 3]`; channels may come first, as torch has them.
      size: pixels per side.
      moments: O.

    Raises:
      UsageError: no image, or numbers out of range.
    """
    if images.ndim >= 3 and images.shape[-3] == 3 and images.shape[-1] != 3:
        images = np.moveaxis(images, -3, -1)
    # No other number of images: tiny ones in a frame would grow to gigabytes.
    is_known = images.ndim == 3 or images.shape[:-3] == (moments,)
    if not is_known or images.shape[-1] != 3 or not images.size:
        raise UsageError(name, f"[h, w, 3] or [{moments}, h, w, 3]", list(images.shape))
    images = _as_uint8(name, images)
    if images.shape[-3:-1] == (size, size):
        return images
    flat = images.reshape(-1, *images.shape[-3:])
    padded = np.stack([_with_pad(image, size) for image in flat])
    return padded.reshape(*images.shape[:-3], size, size, 3)


def square(image: np.ndarray, size: int, *, bgr: bool = False) -> np.ndarray:
    """Returns the middle of a camera's image `[h, w, 3]` as `[size, size, 3]` uint8 RGB.

    The longer side is cropped, so a policy that was trained on square pictures sees them at their
    scale; a server pads instead (`adapt`).

    Args:
      image: uint8, or floats in [0, 1].
      size: pixels per side, `policy.settings.image_size`.
      bgr: True if the channels are blue, green, red, as OpenCV's.

    Raises:
      UsageError: no image, or numbers out of range.
    """
    image = np.asarray(image)
    if image.ndim != 3 or image.shape[-1] != 3 or not image.size:
        raise UsageError("image", "[h, w, 3]", list(image.shape))
    height, width = image.shape[:2]
    side = min(height, width)
    top, left = (height - side) // 2, (width - side) // 2
    image = image[top : top + side, left : left + side, :: -1 if bgr else 1]
    return adapt("image", image, size, 1)


def _as_uint8(name: str, images: np.ndarray) -> np.ndarray:
    kind = images.dtype.kind
    if images.dtype == np.uint8:
        return images
    if kind not in "fiu":
        raise UsageError(name, "uint8 or floats in [0, 1]", images.dtype)
    low, high = float(images.min()), float(images.max())
    most, text = (1.0, "floats in [0, 1]") if kind == "f" else (255.0, "numbers up to 255")
    if not 0.0 <= low <= high <= most:  # NaN too
        raise UsageError(name, text, f"{low:g} to {high:g}")
    return np.rint(images * (255.0 if kind == "f" else 1.0)).astype(np.uint8)


def _with_pad(image: np.ndarray, size: int) -> np.ndarray:
    """Scales an image `[h, w, 3]` to fit into a black square."""
    height, width = image.shape[:2]
    scale = size / max(height, width)
    high, wide = max(1, int(height * scale)), max(1, int(width * scale))
    whole = Image.fromarray(np.ascontiguousarray(image))
    resized = whole.resize((wide, high), Image.Resampling.BILINEAR)
    top, left = (size - high) // 2, (size - wide) // 2
    padded = np.zeros((size, size, 3), np.uint8)
    padded[top : top + high, left : left + wide] = np.asarray(resized)
    return padded
