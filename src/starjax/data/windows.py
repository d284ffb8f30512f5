"""Demonstrations as one flat dataset, and the windows of it that a training step sees.

A window is named by its frame: sampling draws frame numbers, and the same index arithmetic serves
a dataset that is resident on the device (arrays, inside jit) and one in host memory or on disk.
"""

from collections.abc import Callable
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.core.types import Array, Command, Observation, Tree

_CHUNK = 1 << 13


@flax.struct.dataclass
class Dataset:
    """D demonstrations, F frames in all, one after another, and perhaps unused rows after them.

    The leaves are jax arrays, or on the host: numpy arrays, memory maps, or anything with `shape`,
    `dtype` and `[int array [N]] -> numpy array [N, ...]`.

    Attributes:
      observation: Observation `[F, A]`, its images `[F, h, w, 3]`.
      command: Command `[F, A]`; the one issued at frame t is the pose for t + 1.
      trocar: TrocarFrame `[D, A]`.
      episode: `[F]` int32, which demonstration a frame belongs to.
      start: `[D]` int32, first frame of each demonstration.
      length: `[D]` int32, its number of frames.
      sources: `redraw.Sources` of the images, on the device or the host; None unless training draws
        some anew.
    """

    observation: Observation
    command: Command
    trocar: rcm.TrocarFrame
    episode: Any
    start: Any
    length: Any
    sources: Any = None


@flax.struct.dataclass
class Batch:
    """B windows.

    Attributes:
      observation: Observation `[B, O, A]` of frames t - O + 1 .. t.
      command: Command `[B, H, A]` issued at frames t .. t + H - 1.
      trocar: TrocarFrame `[B, A]`.
    """

    observation: Observation
    command: Command
    trocar: rcm.TrocarFrame


def split_holdout(
    start: np.ndarray, length: np.ndarray, trocar: rcm.TrocarFrame, holdout: int
) -> tuple[np.ndarray, np.ndarray]:
    """Splits the frames into training and held-out ones, by whole demonstrations.

    Args:
      start: `[D]` first frame of each demonstration.
      length: `[D]` frames in each.
      trocar: fields `[D, A]`.
      holdout: demonstrations to keep out, spread evenly over the dataset; at most a quarter of
        them all, and none that is the last one at its trocars.

    Returns:
      `[F_train]` and `[F_holdout]` int32 frame numbers.
    """
    start, length = np.asarray(start), np.asarray(length)
    count = min(holdout, len(start) // 4)  # a small dataset keeps its demonstrations for training
    places = np.concatenate([np.asarray(field) for field in trocar.trocar], -1)
    place = np.unique(places, axis=0, return_inverse=True)[1].reshape(-1)
    left = np.bincount(place)
    kept_out = []
    for demo in ((np.arange(count) + 0.5) * len(start) / max(count, 1)).astype(int).tolist():
        # A trocar that is trained nowhere else would make the error one of generalisation.
        if left[place[demo]] > 1:
            left[place[demo]] -= 1
            kept_out.append(demo)
    frames = [np.arange(s, s + n, dtype=np.int32) for s, n in zip(start, length, strict=True)]
    train = [frames[d] for d in range(len(frames)) if d not in kept_out]
    if not train:
        raise ValueError("dataset: expected at least one demonstration, got none")
    held = [frames[d] for d in kept_out]
    return np.concatenate(train), np.concatenate(held or [np.zeros(0, np.int32)])


def strided(dataset: Dataset, frames: np.ndarray, stride: int) -> np.ndarray:
    """Returns every `stride`-th frame of each demonstration, of those given."""
    first = np.asarray(dataset.start)[np.asarray(dataset.episode)[frames]]
    return frames[(frames - first) % stride == 0]  # counted from each demonstration's own start


def observed_frames(dataset: Dataset, obs_horizon: int, stride: int) -> np.ndarray | None:
    """Returns the frames `[R]` that windows of a stride observe, None for all."""
    if stride <= obs_horizon:
        return None
    frames = np.arange(int(np.sum(dataset.length)), dtype=np.int32)
    first = np.asarray(dataset.start)[np.asarray(dataset.episode)[frames]]
    last = strided(dataset, frames, stride)[:, None]
    observed = np.maximum(last + np.arange(1 - obs_horizon, 1), first[last])
    return np.unique(observed).astype(np.int32)


def sample_frames(
    key: jax.Array, frames: jax.Array, batch_size: int, count: int | jax.Array = 0
) -> jax.Array:
    """Draws training frames `[batch_size]` uniformly, with replacement: a function of the key.

    `count`, int32 `[]`, is the number of `frames` if others fill up the array; 0: all of them.
    """
    if isinstance(count, int):
        count = count or len(frames)
    return frames[jax.random.randint(key, (batch_size,), 0, jnp.asarray(count))]


def padded_count(count: int) -> int:
    """Returns `count` rounded up to one of eight sizes per power of two.

    Programs are compiled for the size of a dataset. Datasets of two seeds differ by a hundredth.
    """
    step = 1 << max(count.bit_length() - 4, 0)
    return -(-count // step) * step


def window_frames(frame: Array, first: Array, last: Array, obs_horizon: int, horizon: int):
    """Returns the frame numbers of each window; a demonstration's ends repeat.

    Args:
      frame: `[B]` frame t of each window; works on numpy and on jax arrays alike.
      first: `[B]` first frame of its demonstration.
      last: `[B]` last frame of its demonstration.
      obs_horizon: O.
      horizon: H.

    Returns:
      observed `[B, O]` and commanded `[B, H]` frame numbers.
    """
    # One arithmetic for data on the device, inside jit, and for memory maps.
    np_ = jnp if isinstance(frame, jax.Array) else np
    observed = frame[:, None] + np.arange(1 - obs_horizon, 1, dtype=np.int32)
    commanded = frame[:, None] + np.arange(horizon, dtype=np.int32)
    return (
        np_.maximum(observed, first[:, None]),  # before the start: its first frame
        np_.minimum(commanded, last[:, None]),  # after the end: its last command, a pose to hold
    )


def places(dataset: Dataset) -> Dataset:
    """Returns the dataset without its windows: the places of the episodes, and sources."""
    return dataset.replace(observation=None, command=None, trocar=None)


def control_steps(dataset: Dataset, frame: jax.Array) -> jax.Array:
    """Returns the control step of each frame `[...]` in its episode, from 0."""
    return frame - dataset.start[dataset.episode[frame]]


def gather(
    dataset: Dataset, frame: Array, obs_horizon: int, horizon: int, seen: Array | None = None
) -> Batch:
    """Gathers the windows at frames `[...]`, as arrays of the dataset's kind (numpy or jax).

    `seen`, int32 `[..., O]`, are the control steps that are observed instead of the last O.
    """
    shape = frame.shape
    frame = frame.reshape(-1)
    episode = dataset.episode[frame]
    first = dataset.start[episode]
    last = first + dataset.length[episode] - 1
    observed, commanded = window_frames(frame, first, last, obs_horizon, horizon)
    if seen is not None:
        observed = first[:, None] + seen.reshape(-1, obs_horizon)

    def take(tree, index):
        flat = index.reshape(-1)  # one gather a leaf, for all windows
        return jax.tree.map(
            lambda leaf: leaf[flat].reshape((*shape, *index.shape[1:], *leaf.shape[1:])),
            tree,
        )

    return Batch(
        observation=take(dataset.observation, observed),
        command=take(dataset.command, commanded),
        trocar=take(dataset.trocar, episode),
    )


def over_frames(dataset: Dataset, frames: np.ndarray, fn: Callable[..., np.ndarray]) -> np.ndarray:
    """Computes `fn(observation, command, trocar)` of the given frames as one numpy array.

    `fn` returns a row per frame, or rows that a repeated frame leaves as they are (extrema): chunks
    have one size, so the last one is filled up with its last frame. Images and their features are
    missing: a function of all frames is low-dimensional.
    """
    observation = dataset.observation._replace(images=None, features=None)
    low = (observation, dataset.command, dataset.trocar, dataset.episode)
    if on_device(dataset):  # each index of a device's array would be a program of its own
        low = jax.device_get(low)
    *per_frame, trocars, episode = low
    parts = []
    for i in range(0, len(frames), _CHUNK):
        # Full: one shape, one program
        frame = frames[np.minimum(np.arange(i, i + _CHUNK), len(frames) - 1)]
        observation, command = _take(per_frame, frame)
        part = np.asarray(fn(observation, command, _take(trocars, np.asarray(episode[frame]))))
        parts.append(part[: len(frames) - i] if len(part) == len(frame) else part)
    return np.concatenate(parts)


def on_device(dataset: Dataset) -> bool:
    """Returns True if the frames are jax arrays, which a compiled step can gather from."""
    return isinstance(dataset.episode, jax.Array)


def _take(tree: Tree, index: np.ndarray) -> Tree:
    return jax.tree.map(lambda leaf: np.asarray(leaf[index]), tree)
