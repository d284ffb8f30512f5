"""Functions in background threads, whose results are ready when they are needed."""

import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
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


def run_as_daemon(work: Callable[[], T]) -> "Future[T]":
    """Starts `work` in a thread that the end of the process does not wait for."""
    future: Future[T] = Future()

    def run() -> None:
        try:
            future.set_result(work())
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=run, daemon=True).start()
    return future
