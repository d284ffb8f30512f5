"""Recorded episodes on their way from the device to the host."""

import concurrent.futures
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np

from starjax.data import store
from starjax.rcm.trocar import Trocar

FETCHES = 8  # pictures of episodes that are copied to the host at once


class Episode(NamedTuple):
    """One that is over.

    Attributes:
      outcome: JSON values: which trial it is, and how it ended.
      arrays: of each of `recorder.FIELDS`, parts that make `[length, ...]` along the first axis.
    """

    outcome: store.Record
    arrays: dict[str, list[np.ndarray]]


@jax.jit
def _lane(records: jax.Array, lane: jax.Array) -> jax.Array:
    return records[lane]


def slices(images: jax.Array | None, running: Sequence[int]) -> list[jax.Array]:
    """The pictures of each running lane apart: those of the others are neither copied nor kept."""
    if images is None:
        return []
    share = images.sharding.shard_shape(images.shape)[0]
    on = {(shard.index[0].start or 0) // share: shard.data for shard in images.addressable_shards}
    return [_lane(on[lane // share], np.int32(lane % share)) for lane in running]


def fetch(arrays: Sequence[jax.Array]) -> list[np.ndarray]:
    """The arrays on the host, several copied at once."""
    copy = np.asarray if jax.default_backend() == "cpu" else _through_pinned
    with concurrent.futures.ThreadPoolExecutor(FETCHES) as pool:
        return list(pool.map(copy, arrays))


def _through_pinned(array: jax.Array) -> np.ndarray:
    """A copy by way of pinned memory, which a GPU writes at its full speed.

    It takes that long to come by that it must be used again and again: what is returned holds none.
    """
    return np.array(jax.device_put(array, array.sharding.with_memory_kind("pinned_host")))


def assemble(
    lane: int,
    trial: tuple[int, int],
    trocars: Trocar,
    seed: int,
    status: dict[str, np.ndarray],
    others: list[dict[str, np.ndarray]],
    pictures: list[np.ndarray],
) -> Episode:
    """The episode of a lane that is over, of what was fetched after every segment.

    Args:
      status: `[N]` each, after the last of them.
      others: all but the pictures, `[N, T, ...]` each.
      pictures: of this lane alone, `[T, ...]`.
    """
    length = int(status["length"][lane])
    outcome = {
        "trocar": trial[0],
        "radius": float(trocars.radius[trial[0]]),
        "polar": float(trocars.polar[trial[0]]),
        "azimuth": float(trocars.azimuth[trial[0]]),
        "trial": trial[1],
        "seed": seed,
        "length": length,
        **{name: bool(status[name][lane]) for name in ("collided", "invalid", "loose", "success")},
    }
    fields = {name: [segment[name][lane] for segment in others] for name in others[0]}
    if pictures:
        fields["image"] = pictures
    # It ends in the last segment.
    for parts in fields.values():
        parts[-1] = parts[-1][: length - sum(map(len, parts[:-1]))]
    return Episode(outcome, {name: fields[name] for name in sorted(fields)})
