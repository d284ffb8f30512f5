"""One field of all episodes as one array, read from disk when indexed.

Frames are read by their place in the files, by several threads, instead of being mapped: random
frames take a tenth of the processor's time, a disk serves many requests at once, and nothing but
the frames counts as the process's memory.
"""

import concurrent.futures
import functools
import math
import os
import threading
import weakref
from pathlib import Path
from typing import Any

import numpy as np

_MOST_OPEN = 256  # files of a field at once; systems allow a process about 1,000
_THREADS = 16  # reads at once; they mostly wait for the disk
_ROWS = 8  # for a thread's share at least
_HEADERS = threading.Lock()


class _OpenFile:
    """A .npy file open for random reads, closed when nothing refers to it."""

    def __init__(self, path: Path, rows: int, row_bytes: int, offset: int):
        """Opens a file of `rows` rows, which begin at `offset` if its size fits."""
        self.path, self.rows = path, rows
        self._descriptor = os.open(path, os.O_RDONLY)
        weakref.finalize(self, os.close, self._descriptor)
        is_usual = os.fstat(self._descriptor).st_size == offset + rows * row_bytes
        self.offset = offset if is_usual else _first_row(path)
        if hasattr(os, "posix_fadvise"):  # reading ahead fetches unused frames
            os.posix_fadvise(self._descriptor, 0, 0, os.POSIX_FADV_RANDOM)

    def fill(self, row: int, out: Any) -> None:
        """Reads a row into `out`, an array of its size."""
        if not 0 <= row < self.rows:
            raise IndexError(f"{self.path}: row {row} of {self.rows}")
        view = memoryview(out).cast("B")
        place = self.offset + row * len(view)
        while view:
            data = os.pread(self._descriptor, len(view), place)
            if not data:
                raise OSError(f"{self.path} ends before row {row}")
            view[: len(data)] = data
            view, place = view[len(data) :], place + len(data)


class EpisodeArray:
    """Frames `[F, ...]` of .npy files, one per episode.

    Attributes:
      shape, dtype: of the whole.
    """

    def __init__(self, paths: list[Path], start: np.ndarray, length: np.ndarray):
        """Opens the first file.

        Args:
          paths: `[D]` files.
          start: `[D]` first frame of each.
          length: `[D]` frames of each.
        """
        self._paths, self._start = paths, np.asarray(start)
        first = np.load(paths[0], mmap_mode="r", allow_pickle=False)
        self.shape = (int(np.sum(length)), *first.shape[1:])
        self.dtype, lengths, offset = first.dtype, np.asarray(length), first.offset
        row_bytes = math.prod(first.shape[1:]) * first.dtype.itemsize

        @functools.lru_cache(_MOST_OPEN)
        def opened(episode: int) -> _OpenFile:
            return _OpenFile(paths[episode], int(lengths[episode]), row_bytes, offset)

        self._opened = opened

    def __getitem__(self, index: np.ndarray) -> np.ndarray:
        """Returns the frames at `index` `[N]` as `[N, ...]` in memory."""
        index = np.asarray(index)
        out = np.empty((*index.shape, *self.shape[1:]), self.dtype)
        frames = index.reshape(-1)
        rows = out.reshape(len(frames), -1)
        episode = np.searchsorted(self._start, frames, side="right") - 1
        shares = np.array_split(
            np.arange(len(frames)), min(_THREADS, -(-len(frames) // _ROWS)) or 1
        )

        def fill(share: np.ndarray) -> None:
            for i in share:
                row = int(frames[i] - self._start[episode[i]])
                self._opened(int(episode[i])).fill(row, rows[i])

        if len(shares) == 1:
            fill(shares[0])
        else:
            for _ in _pool().map(fill, shares):
                pass
        return out

    def read(self, rows: int = 0) -> np.ndarray:
        """Returns all frames in memory, followed by zeros up to so many rows."""
        out = np.zeros((max(rows, self.shape[0]), *self.shape[1:]), self.dtype)
        self.read_into(out[: self.shape[0]])
        return out

    def read_into(self, out: Any) -> None:
        """Reads all frames into memory `[F, ...]`."""
        for path, first in zip(self._paths, self._start, strict=True):
            array = np.load(path, mmap_mode="r", allow_pickle=False)
            out[first : first + len(array)] = array


def _first_row(path: Path) -> int:
    """Returns the place of the first row in a .npy file, from its header.

    One thread at a time: numpy reads headers by `ast`, which several threads at once crash in
    Python 3.11 (gh-106905).
    """
    with _HEADERS:
        return np.load(path, mmap_mode="r", allow_pickle=False).offset


@functools.cache
def _pool() -> concurrent.futures.ThreadPoolExecutor:
    """Returns the threads that read, those of all fields."""
    return concurrent.futures.ThreadPoolExecutor(_THREADS, "starjax-read")
