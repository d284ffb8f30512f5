"""Columns of times in any dataset: known by their names, in units known by their steps."""

import re
from collections.abc import Mapping, Sequence

import numpy as np

from starjax.addons.formats.base import Column, Source

_UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
_USUAL = (2e-4, 0.9)  # s, periods of recordings
_WORDS = {"time", "times", "timestamp", "timestamps", "stamp", "stamps", "elapsed"}
_OTHER_TIMES = {"left", "limit", "max", "delta", "to", "next", "remaining"}
_SECONDS = re.compile(r"(.*[./_])?secs?")


def named(columns: Mapping[str, Column]) -> dict[str, tuple[str, ...]]:
    """Returns the columns of times, by name: seconds with nanoseconds are two."""
    single = {name for name, column in columns.items() if column.shape in ((), (1,))}
    found = {}
    for name in sorted(single):
        words = set(_split(name))
        if words - {*_UNITS} == {"t"} or (words & _WORDS and not words & _OTHER_TIMES):
            found[name] = (name,)
        if _SECONDS.fullmatch(name):
            found.pop(name, None)
            stem = name.removesuffix("s").removesuffix("sec")
            endings = (f"{stem}{end}" for end in ("nsec", "nsecs", "nanosec", "nanosecs"))
            if nano := next((end for end in endings if end in single), None):
                found[name] = (name, nano)
    seconds = {nano for parts in found.values() for nano in parts[1:]}
    return {name: parts for name, parts in found.items() if name not in seconds}


def columns(source: Source) -> list[str]:
    """Returns the columns that clocks are read from."""
    return [part for parts in named(source.columns).values() for part in parts]


def related(source: Source, wanted: Sequence[str]) -> set[str]:
    """Returns the streams that a mapping needs: columns, and clocks that belong to no other."""
    mine = {word for name in wanted for word in _split(name)}
    names = named(source.columns)
    others = {word for name in source.columns if name not in names for word in _split(name)} - mine
    return {*wanted, *(name for name in names if not set(own_words(name)) & others)}


def other_unit(usual: float, hz: float) -> str:
    """Returns a question after times whose steps are no seconds."""
    scale = unit_of(np.array([0.0, usual]), 1.0 / hz if hz else 0.0)
    unit = next(name for name, size in _UNITS.items() if size == scale)
    return "" if unit == "s" else f": are times in {unit}?"


def unit_of(values: np.ndarray, period: float) -> float:
    """Returns the unit in s of times: the one whose steps are nearest to `period`, 0 if unknown."""
    usual = usual_period(values)
    if period > 0.0 and usual > 0.0:
        return min(_UNITS.values(), key=lambda unit: abs(np.log(usual * unit / period)))
    fits = (unit for unit in _UNITS.values() if _USUAL[0] <= usual * unit <= _USUAL[1])
    return next(fits, 1.0)


def usual_period(times: np.ndarray) -> float:
    """Returns the median of the steps that are not 0, infinite without any."""
    steps = np.diff(times)
    steps = steps[steps > 0.0]
    return float(np.median(steps)) if len(steps) else np.inf


def values(arrays: Mapping[str, np.ndarray], parts: tuple[str, ...]) -> np.ndarray:
    """Returns the times `[T]` of a clock, in its unit."""
    whole = np.asarray(arrays[parts[0]], np.float64).reshape(-1)
    return whole + 1e-9 * np.asarray(arrays[parts[1]]).reshape(-1) if parts[1:] else whole


def own_words(name: str) -> list[str]:
    """Returns the words of a clock's name that say whose it is."""
    general = _WORDS | {"t", "header", "observation", "observations", "obs", "sec", "secs", *_UNITS}
    return [word for word in _split(name) if word not in general]


def _split(name: str) -> list[str]:
    return [word for word in re.split(r"[^a-z0-9]+", name.lower()) if word]
