"""Contract of time of all formats: stamps, log times, rates and ages are compared here alone.

Steps are those of one clock: the first column of an arm that a mapping names, where columns are
streams of their own (bags), otherwise the rows. A step shows of every stream its last value at or
before the step. Steps before a stream's first value are omitted; an episode with an older value
than `max_gap_s` is omitted whole, as one with such a gap is.
"""

from collections.abc import Collection, Iterator, Mapping
from typing import NamedTuple

import numpy as np

from starjax.addons.formats import clocks
from starjax.addons.formats.base import Source, StepTimes
from starjax.core import errors

APART = 0.1  # s, by which clocks of one episode may differ
MAX_GAP_S = 0.5  # s without a value, unless a mapping says more
_RATE = 0.05  # relative, by which a rate may differ from a declared one
MOST_APART = (1.0 + _RATE) * APART  # s between the values of a stream that needs no note
_HZ = 30.0  # for every dataset: faster steps lose nothing
_PERIODS = 3.0  # periods of a stream, after which its value is old
_ROUND = 1e-6  # s, of stamps that are sums of seconds and nanoseconds
_ONE_START = 60.0  # s; clocks farther apart count from starts of their own


class Gap(ValueError):
    """An episode that leaves too long a time without a value."""


class Stream(NamedTuple):
    """Messages of a topic in the order of the log: `[N]` s by their headers, and by the log."""

    stamps: np.ndarray
    logged: np.ndarray


def join(streams: Mapping[str, Stream], clock: str) -> tuple[StepTimes, dict[str, np.ndarray]]:
    """Joins streams at the messages of one of them.

    Times are those of the headers; where the headers of two streams differ by more than `APART`
    against the log, their computers' clocks do, and times are those of the log.

    Returns:
      The timing of the steps, and of each stream the message `[T]` that a step shows, -1 for none.
    """
    notes = [f"{name}: its stamps drift {shift:.2g} s" for name, shift in _drifts(streams)]
    offsets = {name: float(np.median(s.logged - s.stamps)) for name, s in streams.items()}
    worst = max(offsets, key=lambda name: abs(offsets[name] - offsets[clock]))
    shift = offsets[clock] - offsets[worst]
    is_apart = abs(shift) > APART
    use_log = is_apart and all(map(_has_log, streams.values()))
    if is_apart:
        by = "joined by the times of the log" if use_log else "the log has no times to join by"
        notes.append(f"{worst}: its stamps are {shift:.2f} s from those of {clock}; {by}")
    times = {name: s.logged if use_log else s.stamps for name, s in streams.items()}
    steps = np.sort(times[clock], kind="stable")
    rows, ages, periods = {}, {}, {}
    for name, stamps in times.items():
        order = np.argsort(stamps, kind="stable")
        last = np.searchsorted(stamps[order], steps + _ROUND, side="right") - 1
        rows[name] = np.where(last < 0, -1, order[np.maximum(last, 0)])
        ages[name] = np.where(last < 0, np.inf, steps - stamps[rows[name]])
        periods[name] = clocks.usual_period(stamps[order])
        slow, fast = len(steps), len(stamps)
        if name != clock and fast > 2 * slow and clocks.usual_period(steps) > 1.1 / _HZ:
            notes.append(f"{name} has {fast} messages for the {slow} steps of {clock}")
    return StepTimes(steps, ages, periods, notes), rows


def _has_log(stream: Stream) -> bool:
    """Returns True if the log's times span the headers': a converted bag may have one time."""
    spans = [np.ptp(times) if len(times) else 0.0 for times in stream]
    return abs(spans[0] - spans[1]) <= _RATE * spans[0] + APART


def _drifts(streams: Mapping[str, Stream]) -> Iterator[tuple[str, float]]:
    """Yields streams whose headers' clock does not run as the log's, with the difference in s."""
    for name, stream in streams.items():
        offset, third = stream.logged - stream.stamps, len(stream.logged) // 3
        if third and _has_log(stream):
            shift = float(np.median(offset[-third:]) - np.median(offset[:third]))
            if abs(shift) > APART:
                yield name, shift


def of_rows(
    source: Source, arrays: Mapping[str, np.ndarray], times: np.ndarray | None, hz: float
) -> StepTimes | None:
    """Returns the timing of rows by the columns of times; None without any.

    Args:
      arrays: columns of an episode, with those of `clocks.columns`.
      times: `[T]` s of the steps; None for the column of times whose name says least else.
      hz: declared rate, 0 for none.
    """
    found = {
        name: clocks.values(arrays, parts) for name, parts in clocks.named(source.columns).items()
    }
    found = {name: x for name, x in found.items() if np.isfinite(x).all() and np.ptp(x) > 0.0}
    main = min(found, key=lambda name: (len(clocks.own_words(name)), name), default=None)
    period = 1.0 / hz if hz else 0.0
    if times is None:
        if main is None:
            return None
        times = found[main] * clocks.unit_of(found[main], period)
    others = {name: x for name, x in found.items() if (np.diff(x) >= 0.0).all()}
    ages, periods, notes = {}, {}, []
    for name, values in others.items():
        values = values * clocks.unit_of(values, clocks.usual_period(times))
        if not clocks.own_words(name):  # no stream's: another clock of the rows
            spans = float(np.ptp(times)), float(np.ptp(values))
            if abs(spans[1] - spans[0]) > APART + _RATE * spans[0]:
                notes.append(f"{name} spans {spans[1]:.2f} s, the steps {spans[0]:.2f} s")
            continue
        periods[name], start = clocks.usual_period(values), times[0] - values[0]
        if abs(start) > max(APART, _PERIODS * periods[name]):
            if abs(start) < _ONE_START:
                notes.append(f"{name} begins {start:.2f} s before the steps: two clocks?")
            values = values + start
        ages[name] = times - values
    return StepTimes(times, ages, periods, notes)


def anomalies(source: Source, episode: int, arrays: Mapping[str, np.ndarray]) -> list[str]:
    """Returns notes on the times of an episode that no mapping names.

    Args:
      arrays: columns of the episode, with those of `clocks.columns`.
    """
    if source.timing is not None:
        clocked = source.timing(episode)
    elif (clocked := of_rows(source, arrays, None, source.hz)) is None:
        return []
    streams = [name for name, period in clocked.periods.items() if np.isfinite(period)]
    try:
        steps = of_steps(clocked.times, source.hz, MAX_GAP_S, is_strict=False)
        return [*steps, *usable(clocked, streams, MAX_GAP_S)[1]]
    except Gap as gap:
        return [*clocked.notes, str(gap)]


def of_rates(files_hz: float, hz: float) -> list[str]:
    """Returns a note if the files and a mapping declare different rates, 0 for none."""
    is_same = not (files_hz and hz) or abs(hz / files_hz - 1.0) <= _RATE
    return [] if is_same else [f"the files declare {files_hz:g} Hz, the mapping {hz:g} Hz"]


def of_steps(times: np.ndarray, hz: float, max_gap_s: float, is_strict: bool = True) -> list[str]:
    """Returns notes on rates and gaps of an episode's steps.

    Args:
      times: `[T]` s.
      hz: declared rate; 0 for none.
      is_strict: True if the motion is read at these times, so they must rise.

    Raises:
      Gap: there is a longer one than `max_gap_s`.
      errors.UsageError: the times do not rise.
    """
    steps = np.diff(times)
    if not len(steps):
        return []
    if (steps <= 0.0).any():
        at = int(np.argmax(steps <= 0.0)) + 1
        got = f"{times[at]:.4f} s at step {at}"
        if is_strict:
            raise errors.UsageError("time", "times that rise", got)
        return [f"its times do not rise: {got}"]
    usual, most = float(np.median(steps)), int(np.argmax(steps))
    if steps[most] > max_gap_s:
        raise Gap(
            f"a gap of {steps[most]:.2f} s at {times[most] - times[0]:.2f} s"
            f"{clocks.other_unit(usual, hz)}"
        )
    notes = []
    if hz and abs(usual * hz - 1.0) > _RATE:
        question = clocks.other_unit(usual, hz)
        notes.append(
            f"its times show {1.0 / usual:.3g} Hz, the declared rate is {hz:g} Hz{question}"
        )
    if usual > MOST_APART:
        notes.append(f"its steps are {usual:.2g} s apart; filled in")
    if count := int((steps > 1.5 * usual).sum()):
        notes.append(f"{count} gaps, the longest of {steps[most]:.2f} s; filled in")
    return notes


def usable(timing: StepTimes, signals: Collection[str], max_gap_s: float) -> tuple[int, list[str]]:
    """Returns the first step at which every signal has a value, and notes on old values.

    Args:
      signals: streams that move; a column of facts, such as the trocar, has no age.

    Raises:
      Gap: a signal has no value, or an older one than `max_gap_s`.
    """
    ages = {name: age for name, age in timing.ages.items() if name in signals}
    first, notes = 0, list(timing.notes)
    for name, age in ages.items():
        is_known = np.isfinite(age)
        if not is_known.any():
            raise Gap(f"{name} has no value in its time")
        begins = int(np.argmax(is_known))
        first, late = max(first, begins), timing.times[begins] - timing.times[0]
        if late > max_gap_s:
            notes.append(f"{name} begins {late:.2f} s late; {begins} steps omitted")
    for name, age in ages.items():
        off = np.abs(age[first:])
        most = int(np.argmax(off))
        if off[most] > max_gap_s:
            at = timing.times[first + most] - timing.times[0]
            raise Gap(f"{name} is {age[first + most]:.2f} s old at {at:.2f} s")
        bound = max(APART, _PERIODS * timing.periods[name])
        if count := int((off > bound).sum()):
            notes.append(
                f"{name} is up to {off[most]:.2f} s old, in {count} steps over {bound:.2g} s"
            )
    return first, notes
