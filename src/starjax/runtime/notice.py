"""One line for the user of a command while programs are compiled for seconds."""

import contextlib
import threading
from collections.abc import Callable, Iterator

AFTER_S = 3.0
_thread = threading.local()
_reports: list[Callable[[], None]] = []


def once(report: Callable[[], None]) -> None:
    """Registers a function, called once if this process waits for compilers for seconds."""
    _reports[:] = [report]


@contextlib.contextmanager
def waiting() -> Iterator[None]:
    """Counts the block as a time in which compilers work."""
    timer = threading.Timer(AFTER_S, _report)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()


@contextlib.contextmanager
def call() -> Iterator[None]:
    """Counts the block from `traced` on, if a program is traced in it."""
    before = getattr(_thread, "stack", None)
    with contextlib.ExitStack() as stack:
        _thread.stack = stack
        try:
            yield
        finally:
            _thread.stack = before


def traced() -> None:
    """Notes that a program is traced, which is then compiled."""
    if _reports and (stack := getattr(_thread, "stack", None)):
        stack.enter_context(waiting())


def _report() -> None:
    if _reports:
        _reports.pop()()
