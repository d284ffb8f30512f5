"""Ranges of settings, part of the fields' types, where the check and `--help` read them.

Standard library only.
"""

import dataclasses
import math
import operator
import typing
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from starjax.core import errors

if TYPE_CHECKING:  # for annotations alone
    from _typeshed import DataclassInstance

MOST = 2**31 - 1  # whole numbers of compiled programs have 32 bits
# Metadata of a field that holds settings whose names stand among those of the dataclass itself.
INLINE = {"inline": True}
_OPEN = (MOST, math.inf)  # bounds that messages omit


class Range(NamedTuple):
    """Range of a number, of a tuple each number. Stands on a field: `Annotated[int, Range(0, 8)]`.

    Attributes:
      low, high: bounds.
      ends: brackets as in mathematics; a round one excludes the bound.
      step: between two whole numbers, from `low` on.
    """

    low: float
    high: float
    ends: str = "[]"
    step: int = 1

    def __str__(self) -> str:
        if self.high in _OPEN:
            return f"more than {self.low:g}" if self.ends[0] == "(" else f"{self.low:g} or more"
        if isinstance(self.low, float):
            return f"in {self.ends[0]}{self.low:g}, {self.high:g}{self.ends[1]}"
        between = f", {self.low + self.step}, ... " if self.step > 1 else " to "
        return f"{self.low}{between}{self.high}"

    def holds(self, value: float) -> bool:
        """Returns True for a number in the range; False for nan."""
        above = value >= self.low if self.ends[0] == "[" else value > self.low
        below = value <= self.high if self.ends[1] == "]" else value < self.high
        return above and below and (isinstance(value, float) or not (value - self.low) % self.step)


# Common ranges.
Count = Annotated[int, Range(1, MOST)]
CountOrZero = Annotated[int, Range(0, MOST)]
Positive = Annotated[float, Range(0.0, math.inf, "()")]
NotNegative = Annotated[float, Range(0.0, math.inf, "[)")]


def fields(
    settings: "DataclassInstance | type[DataclassInstance]", prefix: str = "", path: str = ""
) -> Iterator[tuple[str, str, Any]]:
    """Yields the settings of a dataclass, or of an instance with the types of its parts.

    Each is its name in flags and mistakes, e.g. `train.steps`, its path of attributes, e.g.
    `policy.options.ddim_steps`, and its type.
    """
    kind = settings if isinstance(settings, type) else type(settings)
    hints = typing.get_type_hints(kind, include_extras=True)
    for field in dataclasses.fields(kind):
        hint, where = hints[field.name], f"{path}{field.name}"
        value = None if settings is kind else getattr(settings, field.name)
        if isinstance(hint, type) and dataclasses.is_dataclass(hint) and value is None:
            value = hint()
        if dataclasses.is_dataclass(value):
            inner = prefix if field.metadata == INLINE else f"{prefix}{field.name}."
            yield from fields(value, inner, f"{where}.")
        else:
            yield f"{prefix}{field.name}", where, hint


def within(hint: Any) -> Range | None:
    """Returns the range in a field's type, or None."""
    found = [item for item in getattr(hint, "__metadata__", ()) if isinstance(item, Range)]
    return found[-1] if found else None


def check(settings: "DataclassInstance") -> None:
    """Raises UsageError for the first field out of its range; None is always valid."""
    for name, path, hint in fields(settings):
        value, limit = operator.attrgetter(path)(settings), within(hint)
        for number in value if isinstance(value, tuple) else (value,):
            if limit and number is not None and not limit.holds(number):
                each = "each " if isinstance(value, tuple) else ""
                raise errors.UsageError(name, each + _expected(limit, number), number)


def _expected(limit: Range, number: float) -> str:
    """Returns the range as error messages show it."""
    if isinstance(number, float) and not math.isfinite(number):
        return "a finite number"
    return f"at most {MOST}" if number > limit.high == MOST else str(limit)
