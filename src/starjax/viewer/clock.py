"""Real time: when the next control step is due, and how many were late."""

import time
from collections.abc import Callable

LATE = 1.0  # periods after which a step counts as missed


class Clock:
    """Paces a loop.

    Attributes:
      steps: that were paced. missed: those that began a period or more after they were due.
    """

    def __init__(
        self,
        hz: float,
        now: Callable[[], float] = time.perf_counter,
        sleep: Callable[[float], None] = time.sleep,
    ):
        self._hz, self._now, self._sleep = hz, now, sleep
        self._due: float | None = None
        self.steps = self.missed = 0

    def wait(self, speed: float = 1.0) -> None:
        """Waits until the next step is due; after a missed one time begins anew."""
        now, period = self._now(), 1.0 / (self._hz * speed)
        if self._due is None:
            self._due = now
        late = now - self._due
        if late < 0:
            self._sleep(-late)
        self.steps += 1
        if late >= LATE * period:
            self.missed += 1
            self._due = now
        self._due += period

    def pause(self) -> None:
        """Lets the next step be due whenever it comes."""
        self._due = None
