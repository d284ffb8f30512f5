"""CSV with a header: a file or a folder with a file per episode, or a column `episode`.

Columns are separated by commas, semicolons (numbers may then have decimal commas), bars or tabs;
text is UTF-8, UTF-16 or Latin-1. Dates and times of day are seconds.
"""

import codecs
import contextlib
import re
from collections.abc import Collection, Iterator
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.csv as tables

from starjax.addons.formats import base, per_file
from starjax.addons.formats.base import Column, Source

SUFFIX = ".csv"
_EPISODE = ("episode", "episode_index")  # names of a column that numbers the episodes
_HEAD = 1 << 16  # bytes that show a file's dialect
_NUMBER = r"^\s*[-+]?(\d+([.,]\d*)?|[.,]\d+)([eE][-+]?\d+)?\s*$"


@contextlib.contextmanager
def _open(path: Path) -> Iterator[Source]:
    paths = per_file.files(path, f"*{SUFFIX}")
    whole = per_file.source(paths, _read, hz=0.0)
    numbered = [name for name in _EPISODE if name in whole.columns]
    yield _split(whole, paths[0], numbered[0]) if numbered and len(paths) == 1 else whole


def _read(path: Path, names: Collection[str], rows: slice = slice(None)) -> dict[str, np.ndarray]:
    """Reads columns of numbers, all for no names: a column with a few words is one of them.

    Raises:
      Damaged: a column of `names` has a word in these rows; the message gives file, column and row.
    """
    base.require_fits(path.name, (path.stat().st_size,), np.uint8)
    encoding, delimiter, decimal_point = _dialect(path)
    table = tables.read_csv(
        path,
        tables.ReadOptions(use_threads=False, encoding=encoding),  # threads lose the row's number
        tables.ParseOptions(delimiter=delimiter),
        tables.ConvertOptions(decimal_point=decimal_point),
    )
    table = table.rename_columns([name.strip() for name in table.column_names])
    arrays = {}
    for name in names or table.column_names:
        if name not in table.column_names:
            continue
        cells = table[name]
        if pa.types.is_timestamp(cells.type) or pa.types.is_time(cells.type):
            arrays[name] = _seconds(cells)[rows]
        elif _is_number(cells.type):
            arrays[name] = cells.to_numpy().astype(np.float64)[rows]
        elif (is_number := _are_numbers(cells)) is not None:
            words = np.flatnonzero(~is_number[rows]) + (rows.start or 0)
            if names and len(words):
                # The header is row 1, as in an editor.
                where = f"numbers in column {name}, row {words[0] + 2} of {path.name}"
                raise base.Damaged(f"expected {where}, got {str(cells[int(words[0])])!r}")
            texts = np.where(is_number, cells.to_numpy(zero_copy_only=False), "nan")[rows]
            arrays[name] = np.array([float(text.replace(",", ".")) for text in texts])
    return arrays


def _seconds(cells: pa.ChunkedArray) -> np.ndarray:
    """Returns dates or times of day as s, NaN for empty cells."""
    kind = pa.timestamp("ns") if pa.types.is_timestamp(cells.type) else pa.time64("ns")
    counts = pc.cast(pc.cast(cells, kind), pa.int64()).to_numpy(zero_copy_only=False)
    return 1e-9 * np.asarray(counts, np.float64)


def _are_numbers(cells: pa.ChunkedArray) -> np.ndarray | None:
    """Returns flags of the rows with a number, None for a column of words."""
    if not pa.types.is_string(cells.type):
        return None
    flags = pc.fill_null(pc.match_substring_regex(cells, _NUMBER), False)
    is_number = flags.to_numpy().astype(bool)
    return is_number if 2 * is_number.sum() > len(is_number) else None


def _dialect(path: Path) -> tuple[str, str, str]:
    """Returns the encoding, the delimiter and the decimal point of a file."""
    with open(path, "rb") as file:
        data = file.read(_HEAD)
    encoding = "utf-8"
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        encoding, data = "utf-16", data[: len(data) // 2 * 2]
    else:
        try:
            codecs.getincrementaldecoder("utf-8")().decode(data)
        except UnicodeDecodeError:
            encoding = "latin-1"
    header, _, body = data.decode(encoding, "ignore").partition("\n")
    delimiter = max(",;\t|", key=header.count)
    expected = "columns separated by , ; | or tabs in the first line"
    base.require(delimiter in header, expected, repr(header[:40].strip()))
    has_commas = delimiter != "," and re.search(r"\d,\d", body) is not None
    return encoding, delimiter, "," if has_commas else "."


def _is_number(kind: pa.DataType) -> bool:
    return pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_boolean(kind)


def _split(whole: Source, path: Path, by: str) -> Source:
    """Returns the episodes of one file whose rows are numbered by a column."""
    numbers = whole.read(0, [by])[by]
    firsts = np.flatnonzero(np.diff(numbers, prepend=np.nan) != 0)
    ends = np.append(firsts[1:], len(numbers))
    again = len(np.unique(numbers)) < len(firsts)
    base.require(not again, f"rows in the order of {by}", "an episode that begins twice")

    def read(episode: int, names: Collection[str]) -> dict[str, np.ndarray]:
        return _read(path, names, slice(firsts[episode], ends[episode]))

    columns: dict[str, Column] = {n: c for n, c in whole.columns.items() if n != by}
    return whole._replace(lengths=(ends - firsts).tolist(), columns=columns, read=read)


def _recognises(path: Path) -> bool:
    if path.is_dir():
        return bool(per_file.listed(path, f"*{SUFFIX}"))
    return path.suffix == SUFFIX


FORMAT = base.Format(
    "CSV with a header, a file per episode", per_file.same_name, _recognises, _open
)
