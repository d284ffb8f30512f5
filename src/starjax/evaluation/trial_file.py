"""The trials of a result in a compressed file next to it, a twentieth of their size as JSON.

result.json may hold `trials` as a list of records, or as the name of such a file in its folder.
There every field is a column, `[M]` or `[M, A]`; a field within a record, as `labels`, is a column
for each of its names, `labels.<name>`. Floats are stored as float32, their original type.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from starjax.runtime import files

Record = dict[str, Any]


def columns(records: Sequence[Record]) -> dict[str, np.ndarray]:
    """Turns records with the same fields into columns.

    Raises:
      ValueError: a record has other fields than the first one, or one holds no number.
    """
    flat = [dict(_flat(record)) for record in records]
    names = list(flat[0]) if flat else []
    for row, record in enumerate(flat):
        if record.keys() != set(names):
            raise ValueError(f"records[{row}]: expected {names}, got {list(record)}")
    found = {name: np.array([record[name] for record in flat]) for name in names}
    for name, column in found.items():
        if column.dtype.kind not in "bif":
            raise ValueError(f"records: expected numbers in {name}, got {column.dtype}")
    return {
        name: column.astype(np.float32) if column.dtype.kind == "f" else column
        for name, column in found.items()
    }


def records(columns: Mapping[str, np.ndarray]) -> list[Record]:
    """Turns columns into records, one a row."""
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    found = []
    for row in rows:
        record: Record = {}
        for name, value in zip(columns, row, strict=True):
            place, _, label = name.partition(".")
            if label:
                record.setdefault(place, {})[label] = value
            else:
                record[name] = value
        found.append(record)
    return found


def detach(file: Path) -> None:
    """Moves the trials of the result `file` into a file next to it; no-op if already moved.

    Raises:
      ValueError: the file is damaged, or its trials are no table.
    """
    result = files.read_json(file)
    if isinstance(result.get("trials"), list):
        beside = file.with_suffix(".trials.npz")
        files.write_npz(beside, columns(result["trials"]))
        files.write_json(file, {**result, "trials": beside.name})


def read(file: Path) -> dict[str, Any]:
    """Reads a result, its trials as records wherever they lie.

    Raises:
      ValueError: a file is damaged or missing; the message names it.
    """
    result = files.read_json(file)
    name = result.get("trials")
    if isinstance(name, str):
        beside = file.parent / name
        if beside.parent != file.parent or not beside.is_file():
            raise ValueError(f"{file}: trials: expected a file in its folder, got {name!r}")
        without = {"labels": {}}  # for a task without labels
        result["trials"] = [without | trial for trial in records(files.read_npz(beside))]
    return result


def _flat(record: Record) -> list[tuple[str, Any]]:
    found = []
    for name, value in record.items():
        if isinstance(value, Mapping):
            found += [(f"{name}.{label}", part) for label, part in value.items()]
        else:
            found.append((name, value))
    return found
