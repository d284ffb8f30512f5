"""Result of one check, and its line."""

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

from starjax import errors

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


def verdict(subject: str, faults: Iterable[str], text: str = "") -> Check:
    """Returns one check with all faults, or with `text` without a fault."""
    found = list(faults)
    return failed(subject, "; ".join(found)) if found else Check(subject, text)


def counted(counts: dict[str, int]) -> str:
    """Returns counts as text, the largest first."""
    rows = sorted(counts.items(), key=lambda row: -row[1])
    return ", ".join(f"{name} ({count})" for name, count in rows)
