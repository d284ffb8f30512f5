"""CSV with a header: a file or a folder with a file per episode, or a column `episode`."""

import contextlib
from collections.abc import Collection, Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv as tables

from starjax.addons.formats import base, per_file
from starjax.addons.formats.base import Column, Source

SUFFIX = ".csv"
_EPISODE = ("episode", "episode_index")  # names of a column that numbers the episodes


@contextlib.contextmanager
def _open(path: Path) -> Iterator[Source]:
    paths = per_file.files(path, f"*{SUFFIX}")
    whole = per_file.source(paths, _read, hz=0.0)
    numbered = [name for name in _EPISODE if name in whole.columns]
    yield _split(whole, numbered[0]) if numbered and len(paths) == 1 else whole


def _read(path: Path) -> dict[str, np.ndarray]:
    base.require_fits(path.name, (path.stat().st_size,), np.uint8)
    table = tables.read_csv(path)
    return {
        name: table[name].to_numpy().astype(np.float64)
        for name in table.column_names
        if _is_number(table[name].type)
    }


def _is_number(kind: pa.DataType) -> bool:
    return pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind)


def _split(whole: Source, by: str) -> Source:
    """Returns the episodes of one file whose rows are numbered by a column."""
    numbers = whole.read(0, [by])[by]
    firsts = np.flatnonzero(np.diff(numbers, prepend=np.nan) != 0)
    ends = np.append(firsts[1:], len(numbers))
    again = len(np.unique(numbers)) < len(firsts)
    base.require(not again, f"rows in the order of {by}", "an episode that begins twice")

    def read(episode: int, names: Collection[str]) -> dict[str, np.ndarray]:
        rows = slice(firsts[episode], ends[episode])
        return {name: array[rows] for name, array in whole.read(0, names).items()}

    columns: dict[str, Column] = {n: c for n, c in whole.columns.items() if n != by}
    return whole._replace(lengths=(ends - firsts).tolist(), columns=columns, read=read)


def _recognises(path: Path) -> bool:
    if path.is_dir():
        return any(path.glob(f"*{SUFFIX}"))
    return path.suffix == SUFFIX


FORMAT = base.Format(
    "CSV with a header, a file per episode", per_file.same_name, _recognises, _open
)
