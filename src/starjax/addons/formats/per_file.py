"""Datasets of a file per episode: listed once, read one at a time."""

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

from starjax.addons.formats import base
from starjax.addons.formats.base import Column, Source

_NUMBER = re.compile(r"\d+")
_Summary = TypeVar("_Summary")


def same_name(column: str) -> str:
    """Returns the name of a starjax column in formats without names of their own."""
    return column


def listed(folder: Path, pattern: str) -> list[Path]:
    """Returns the files of a pattern in a folder, ordered by the numbers in their names.

    Hidden ones are skipped: macOS writes `._episode_0.csv` next to `episode_0.csv`.
    """
    paths = sorted(folder.glob(pattern), key=_key)
    return [
        base.require_inside(folder, path)
        for path in paths
        if not any(part.startswith(".") for part in path.relative_to(folder).parts)
    ]


def files(path: Path, pattern: str) -> list[Path]:
    """Returns the files of a dataset at a folder or single file."""
    paths = listed(path, pattern) if path.is_dir() else [path]
    base.require(bool(paths), f"files {pattern}", f"none in {path}")
    return paths


def summarise(
    names: Sequence[str], look: Callable[[int], _Summary]
) -> tuple[dict[int, _Summary], dict[int, str]]:
    """Looks at every episode: returns summaries and faults by its number.

    Raises:
      Damaged: every one has a fault.
    """
    summaries, faults = {}, {}
    for episode, name in enumerate(names):
        try:
            summaries[episode] = look(episode)
        # As in `base.explained`: a damaged file makes a library raise nearly anything.
        except Exception as error:
            faults[episode] = f"{name}: {base.reason(error)}"
    if not summaries:
        raise base.Damaged(next(iter(faults.values())))
    return summaries, faults


def source(
    paths: Sequence[Path],
    read_file: Callable[[Path, Collection[str]], Mapping[str, np.ndarray]],
    hz: float,
    look: Callable[[Path], tuple[int, dict[str, Column]]] | None = None,
) -> Source:
    """Returns a source of files that are read whole; one that cannot be read is a fault.

    Args:
      paths: a file per episode.
      read_file: (path, names of columns, none for all) -> columns `[T, ...]`. Columns that other
        files lack are left to errors of those that read them.
      hz: control steps per second; 0 if unknown.
      look: path -> control steps and columns; by default, of all that `read_file` returns.
    """

    def read_all(path: Path) -> tuple[int, dict[str, Column]]:
        arrays = read_file(path, ())
        base.require(bool(arrays), "columns of numbers", "none")
        columns = {n: Column(array.shape[1:], array.dtype.name) for n, array in arrays.items()}
        return len(next(iter(arrays.values()))), columns

    look = look or read_all
    summaries, faults = summarise([path.name for path in paths], lambda i: look(paths[i]))
    lengths = [summaries[i][0] if i in summaries else 0 for i in range(len(paths))]

    def read(episode: int, names: Collection[str]) -> dict[str, np.ndarray]:
        arrays = read_file(paths[episode], names)
        for name in names:
            base.require(name in arrays, f"a column {name}", f"none in {paths[episode]}")
        return {name: arrays[name] for name in names}

    columns = next(columns for _, columns in summaries.values())
    return Source(hz, lengths, columns, read, faults=faults)


def _key(path: Path) -> str:
    """Returns a key by which `episode_10` follows `episode_9`."""
    return _NUMBER.sub(lambda match: match[0].zfill(12), str(path))
