"""Copies recorded images from the devices to the host, those of running episodes only."""

import concurrent.futures
from collections.abc import Sequence

import jax
import numpy as np

AT_ONCE = 8  # episodes whose images are copied together


@jax.jit
def _lane(records: jax.Array, lane: jax.Array) -> jax.Array:
    return records[lane]


def slices(images: jax.Array, running: Sequence[int]) -> list[jax.Array]:
    """Splits off the images `[N, T, ...]` of each running lane; others are neither copied nor
    kept."""
    share = images.sharding.shard_shape(images.shape)[0]
    on = {(shard.index[0].start or 0) // share: shard.data for shard in images.addressable_shards}
    return [_lane(on[lane // share], np.int32(lane % share)) for lane in running]


def fetch(arrays: Sequence[jax.Array]) -> list[np.ndarray]:
    """Copies arrays to the host, several at once."""
    copy = np.asarray if jax.default_backend() == "cpu" else _through_pinned
    with concurrent.futures.ThreadPoolExecutor(AT_ONCE) as pool:
        return list(pool.map(copy, arrays))


def _through_pinned(array: jax.Array) -> np.ndarray:
    """Copies by way of pinned memory, which a GPU writes at its full speed.

    Pinned memory is slow to allocate and must be reused, so the returned array holds none.
    """
    return np.array(jax.device_put(array, array.sharding.with_memory_kind("pinned_host")))
