"""Images of several datasets as one array: read or drawn into its memory once, or when indexed."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from starjax.data import redraw
from starjax.data.episode_array import EpisodeArray

Images = EpisodeArray | redraw.DrawnImages  # for one dataset and camera


class JoinedImages:
    """Images of datasets, one after another, read or drawn when they are indexed.

    Attributes:
      shape: of the whole.
      dtype: uint8.
    """

    dtype = redraw.DrawnImages.dtype

    def __init__(self, parts: Sequence[Images]):
        """Keeps the images of each dataset, of one size."""
        self._parts = list(parts)
        ends = np.cumsum([part.shape[0] for part in parts])
        self._first = ends - [part.shape[0] for part in parts]
        self.shape = (int(ends[-1]), *parts[0].shape[1:])

    def __getitem__(self, index: np.ndarray) -> np.ndarray:
        """Returns the images at `index`, integers `[...]`, as `[..., h, w, 3]` in host memory."""
        index = np.asarray(index)
        rows = index.reshape(-1)
        out = np.empty((len(rows), *self.shape[1:]), self.dtype)
        number = np.searchsorted(self._first, rows, side="right") - 1
        for i in np.unique(number):
            chosen = number == i
            out[chosen] = self._parts[i][rows[chosen] - self._first[i]]
        return out.reshape(*index.shape, *self.shape[1:])

    def at(self, place: str, rows: int) -> Any:
        """Returns the images at a place, see `load.place_for`, followed by zeros up to `rows`.

        On the disk they stay as they are: read or drawn when indexed.
        """
        if place == "device":
            return self.on_device(rows)
        return self.read(rows) if place == "host" else self

    def read(self, rows: int = 0) -> np.ndarray:
        """Returns all images in host memory, followed by zeros up to so many rows."""
        out = np.zeros((max(rows, self.shape[0]), *self.shape[1:]), self.dtype)
        for part, first in zip(self._parts, self._first, strict=True):
            part.read_into(out[first : first + part.shape[0]])
        return out

    def on_device(self, rows: int) -> jax.Array:
        """Returns all images in the device's memory, followed by zeros up to so many rows."""
        if jax.default_backend() == "cpu":  # whose memory is the host's
            return jnp.asarray(self.read(rows))
        # In place: the buffer is donated.
        put = jax.jit(
            lambda out, part, first: jax.lax.dynamic_update_slice_in_dim(out, part, first, 0),
            donate_argnums=0,
        )
        out = jnp.zeros((rows, *self.shape[1:]), self.dtype)
        for part, start in zip(self._parts, self._first, strict=True):
            count, batch = part.shape[0], redraw.batch_size()
            look = part.draw_batch if isinstance(part, redraw.DrawnImages) else part.__getitem__
            for first in range(0, count, batch):
                images = look(np.minimum(np.arange(first, first + batch), count - 1))
                out = put(out, images[: count - first], start + first)
        return out
