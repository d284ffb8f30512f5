"""Result of one check, and its line."""

import traceback
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from starjax.core import errors

OK, NOTE, FAILED = "ok", "note", "failed"


class Check(NamedTuple):
    """One line of the answer.

    Attributes:
      subject: e.g. `contacts`.
      text: figures, or the fault.
      status: `OK`, `NOTE` for something to look at, or `FAILED`.
    """

    subject: str
    text: str = ""
    status: str = OK

    def __str__(self) -> str:
        return f"  {self.status:7} {self.subject}{': ' * bool(self.text)}{self.text}"


def failed(subject: str, text: object) -> Check:
    """Returns a check that found a fault."""
    return Check(subject, str(text), FAILED)


def attempt(subject: str, function: Callable[[], Any]) -> tuple[Check | None, Any]:
    """Calls a function; returns the check that a usage error makes of it, and the result."""
    try:
        return None, function()
    except errors.UsageError as error:
        return failed(subject, error), None


def raised(error: BaseException) -> str:
    """Returns type, first line and place of an exception."""
    if isinstance(error, errors.UsageError):
        return str(error)
    text = next((line for line in str(error).splitlines() if line.strip()), "")
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if frame.line]
    place = f" in {Path(frames[-1].filename).name}:{frames[-1].lineno}" if frames else ""
    return f"{type(error).__name__}: {text}{place}"


def verdict(subject: str, faults: Iterable[str], text: str = "") -> Check:
    """Returns one check with all faults, or with `text` without a fault."""
    found = list(faults)
    return failed(subject, "; ".join(found)) if found else Check(subject, text)


def not_finite(record: Any) -> Iterable[str]:
    """Yields the fields of a record that hold NaN, also deep in it."""
    fields = record._asdict() if hasattr(record, "_asdict") else {}
    for name, value in fields.items():
        if hasattr(value, "_asdict"):
            yield from (f"{name}.{text}" for text in not_finite(value))
        elif isinstance(value, Mapping):
            rows = [row for row in value.values() if hasattr(row, "_asdict")]
            yield from (f"{name}.{text}" for row in rows for text in not_finite(row))
        elif isinstance(value, tuple) and any(hasattr(row, "_asdict") for row in value):
            yield from (f"{name}.{text}" for row in value for text in not_finite(row))
        elif _has_nan(value):
            yield f"{name} holds NaN"


def outside(record: Any, ranges: Mapping[str, tuple[float, float]], unit: str = "m") -> list[str]:
    """Returns faults of the numbers of a record that leave their ranges."""
    return [
        f"{name}: expected {low:g} to {high:g} {unit}, got {value:g}"
        for name, (low, high) in ranges.items()
        for value in np.ravel(getattr(record, name)).tolist()
        if not low <= value <= high
    ]


def _has_nan(value: Any) -> bool:
    try:
        return value is not None and bool(np.isnan(np.asarray(value, float)).any())
    except (TypeError, ValueError):
        return False


def counted(counts: dict[str, int]) -> str:
    """Returns counts as text, the largest first."""
    rows = sorted(counts.items(), key=lambda row: -row[1])
    return ", ".join(f"{name} ({count})" for name, count in rows)
