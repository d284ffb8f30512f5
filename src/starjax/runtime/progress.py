"""Progress of long work, its rate and remaining time: a bar on a terminal, else lines."""

import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from typing import TextIO

PLAIN_EVERY_S = 10.0

Advance = Callable[..., None]


@contextlib.contextmanager
def track(
    description: str,
    total: int,
    *,
    unit: str = "it",
    done: int = 0,
    stream: TextIO | None = None,
) -> Iterator[Advance]:
    """Shows progress towards `total` units.

    Args:
      description: name of the work.
      total: units in all.
      unit: their name, as in "episodes".
      done: units that an earlier run finished; they do not count for the throughput.
      stream: output; by default the standard error stream.

    Yields:
      `advance(count, note="")`: `count` more units are done; `note` is shown next to the bar.
    """
    shown = stream or sys.stderr
    show = _terminal if shown.isatty() else _plain
    with show(description, total, unit, done, shown) as advance:
        yield advance


@contextlib.contextmanager
def _terminal(
    description: str, total: int, unit: str, done: int, stream: TextIO
) -> Iterator[Advance]:
    # Imported here: `--help` need not pay for it.
    import rich.console
    import rich.progress

    bar = rich.progress.Progress(
        rich.progress.TextColumn("{task.description}"),
        rich.progress.BarColumn(),
        rich.progress.TextColumn("{task.completed:.0f}/{task.total:.0f} {task.fields[unit]}"),
        rich.progress.TextColumn("{task.fields[rate]}"),
        rich.progress.TimeElapsedColumn(),
        rich.progress.TextColumn("{task.fields[eta]}"),
        rich.progress.TextColumn("{task.fields[note]}"),
        console=rich.console.Console(file=stream),
    )
    meter = _Meter(total, done)
    with bar:
        task = bar.add_task(
            description, total=total, completed=done, unit=unit, rate="", eta="", note=""
        )

        def advance(count: float = 1, note: str = "") -> None:
            meter.add(count)
            left, rate = meter.eta(), meter.rate(unit)
            bar.update(task, completed=meter.done, note=note, eta=left, rate=rate)

        yield advance


@contextlib.contextmanager
def _plain(description: str, total: int, unit: str, done: int, stream: TextIO) -> Iterator[Advance]:
    meter = _Meter(total, done)
    shown = time.monotonic()
    # Programs are compiled before the first unit is done.
    print(f"{description}: {done}/{total} {unit}", file=stream, flush=True)

    def advance(count: float = 1, note: str = "") -> None:
        nonlocal shown
        if meter.is_over():
            return  # the last line is out
        meter.add(count)
        now = time.monotonic()
        if now - shown < PLAIN_EVERY_S and not meter.is_over():
            return
        shown = now
        so_far = f"{description}: {meter.done:.0f}/{total} {unit}"
        parts = [so_far, meter.rate(unit), meter.eta(), note]
        print("  ".join(part for part in parts if part), file=stream, flush=True)

    yield advance


class _Meter:
    """Units done, their rate and the time left.

    On the way both are counted from the end of the first piece of work, in which programs are
    compiled; the last rate is of all.
    """

    def __init__(self, total: int, done: float):
        self.total, self.done = total, done
        self._begun = (done, time.monotonic())
        self._first: tuple[float, float] | None = None

    def add(self, count: float) -> None:
        self.done += count
        if count and self._first is None:
            self._first = (self.done, time.monotonic())

    def is_over(self) -> bool:
        return self.done >= self.total - 1e-6  # shares of a unit rarely add up to the last bit

    def per_second(self) -> float:
        is_past = self._is_past_first() and not self.is_over()  # the last rate is of all units
        done, since = self._first if self._first and is_past else self._begun
        return (self.done - done) / max(time.monotonic() - since, 1e-9)

    def _is_past_first(self) -> bool:
        return self._first is not None and self.done > self._first[0]

    def rate(self, unit: str) -> str:
        rate = self.per_second()
        return f"{rate:.3g} {unit}/s" if rate >= 0.1 else f"{60 * rate:.3g} {unit}/min"

    def eta(self) -> str:
        """Returns time left in words; empty until there is a rate, and after the end."""
        rate = self.per_second()
        if not self._is_past_first() or rate <= 0 or self.is_over():
            return ""
        minutes, seconds = divmod(round((self.total - self.done) / rate), 60)
        hours, minutes = divmod(minutes, 60)
        left = f"{hours}:{minutes:02d}" if hours else f"{minutes}"
        return f"ETA {left}:{seconds:02d}"
