"""Work beside other work."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")


def beside(work: Callable[[], T]) -> Callable[[], T]:
    """Begins `work` in a thread; the function returned waits for it, and returns or raises what it
    did."""
    pool = ThreadPoolExecutor(1, thread_name_prefix="starjax-beside")
    future = pool.submit(work)
    pool.shutdown(wait=False)
    return future.result
