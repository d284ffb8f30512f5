"""Functions in background threads, whose results are ready when they are needed."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")


def run_in_background(work: Callable[[], T]) -> Callable[[], T]:
    """Starts `work` in a thread.

    Returns:
      a function that waits for `work`, then returns its result or raises its error.
    """
    pool = ThreadPoolExecutor(1, thread_name_prefix="starjax-background")
    future = pool.submit(work)
    pool.shutdown(wait=False)
    return future.result
