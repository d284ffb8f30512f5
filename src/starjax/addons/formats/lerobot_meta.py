"""Small files of a LeRobotDataset: tasks, and the splits that info.json names."""

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as parquet

_SPAN = re.compile(r"(\d+):(\d+)")  # episodes of a split


def tasks(path: Path) -> dict[int, str]:
    """Returns the tasks' descriptions by their numbers; empty without a file of tasks."""
    modern, old = path / "meta/tasks.parquet", path / "meta/tasks.jsonl"
    if modern.exists():
        table = parquet.read_table(modern)
        texts = [name for name in table.column_names if pa.types.is_string(table[name].type)]
        if not texts:
            return {}
        rows = table[texts[0]].to_pylist()
        has_numbers = "task_index" in table.column_names
        numbers = table["task_index"].to_pylist() if has_numbers else range(len(rows))
        return {int(number): str(text) for number, text in zip(numbers, rows)}
    if old.exists():
        rows = json_lines(old)
        return {int(row.get("task_index", i)): str(row["task"]) for i, row in enumerate(rows)}
    return {}


def json_lines(path: Path) -> list[Any]:
    """Reads a file of one JSON value a line."""
    return [json.loads(line) for line in path.read_text().split("\n") if line.strip()]


def splits(info: Mapping[str, Any], count: int) -> dict[str, range]:
    """Returns the episodes of each split; values other than spans are ignored.

    Args:
      info: content of meta/info.json.
      count: episodes of the dataset.
    """
    found = info.get("splits")
    spans = found.items() if isinstance(found, dict) else ()
    matches = {str(name): _SPAN.fullmatch(str(span)) for name, span in spans}
    return {
        name: range(int(match[1]), min(int(match[2]), count))
        for name, match in matches.items()
        if match is not None
    }
