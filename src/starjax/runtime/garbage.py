"""Python's garbage collector, held back."""

import contextlib
import gc
from collections.abc import Iterator


@contextlib.contextmanager
def kept() -> Iterator[None]:
    """Nothing is collected meanwhile.

    For tracing, which makes a million objects and throws few away: looking through them again and
    again takes a seventh of its time.
    """
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()
