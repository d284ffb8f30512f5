"""Datasets of a file per episode: listed once, read one at a time."""

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path

import numpy as np

from starjax.addons.formats import base
from starjax.addons.formats.base import Column, Source

_NUMBER = re.compile(r"\d+")


def same_name(column: str) -> str:
    """Returns the name of a starjax column in formats without names of their own."""
    return column


def listed(folder: Path, pattern: str) -> list[Path]:
    """Returns the files of a pattern in a folder, ordered by the numbers in their names."""
    found = sorted(folder.glob(pattern), key=_key)
    return [base.require_inside(folder, file) for file in found]


def files(path: Path, pattern: str) -> list[Path]:
    """Returns the files of a dataset at a folder or single file."""
    found = listed(path, pattern) if path.is_dir() else [path]
    base.require(bool(found), f"files {pattern}", f"none in {path}")
    return found


def source(
    paths: Sequence[Path], read_file: Callable[[Path], Mapping[str, np.ndarray]], hz: float
) -> Source:
    """Returns a source of files that are read whole.

    Args:
      paths: a file per episode.
      read_file: path -> columns `[T, ...]`. Columns that other files lack are left to errors of
        those that read them.
      hz: control steps per second; 0 if unknown.
    """
    first = read_file(paths[0])
    columns = {name: Column(array.shape[1:], array.dtype.name) for name, array in first.items()}
    lengths = [_length(first), *(_length(read_file(path)) for path in paths[1:])]

    def read(episode: int, names: Collection[str]) -> dict[str, np.ndarray]:
        arrays = read_file(paths[episode])
        for name in names:
            base.require(name in arrays, f"a column {name}", f"none in {paths[episode]}")
        return {name: arrays[name] for name in names}

    return Source(hz, lengths, columns, read)


def _length(arrays: Mapping[str, np.ndarray]) -> int:
    base.require(bool(arrays), "columns of numbers", "none")
    return len(next(iter(arrays.values())))


def _key(path: Path) -> str:
    """Returns a key by which `episode_10` follows `episode_9`."""
    return _NUMBER.sub(lambda match: match[0].zfill(12), str(path))
