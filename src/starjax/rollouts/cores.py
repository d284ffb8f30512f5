"""Simulations side by side, each in a thread of its own.

One program's operations are small: a CPU's cores that share each of them wait for each other most
of the time. Two make 1.5 times as many control steps with a program each, of 8 lanes, as with one
of 16 (benchmarks/bench_workers.py).
"""

import collections
import concurrent.futures
from collections.abc import Callable, Generator, Iterable, Iterator
from typing import TypeVar

import jax

from starjax.runtime import xla

CPU_LANES = 8  # of a program on a CPU: with more, what it works on leaves a core's cache

_END = object()
Job = TypeVar("Job")
Found = TypeVar("Found")


def count() -> int:
    """How many simulations this machine runs best at once: one for each core of a CPU, which is
    one device; others share out a program's lanes (`lanes.split`)."""
    on_cpu = jax.default_backend() == "cpu" and len(jax.local_devices()) == 1
    return xla.cores() if on_cpu else 1


def run(
    jobs: Iterable[Job],
    start: Callable[[Job], Generator[Found]],
    at_once: int,
    is_wanted: Callable[[Job], bool] = lambda job: True,
) -> Iterator[Found]:
    """Yields what the jobs' generators yield, as it comes.

    Args:
      jobs: taken in this order.
      start: makes a job's generator, which runs in a thread, never in two at a time.
      at_once: so many are at work together.
      is_wanted: asked in the caller's thread, before a job begins and after each thing that it
        yielded has been taken; a job that is no longer wanted ends there.
    """
    waiting = collections.deque(jobs)
    at_work: dict[concurrent.futures.Future, tuple[Job, Generator[Found]]] = {}
    with concurrent.futures.ThreadPoolExecutor(at_once) as pool:

        def go_on(job: Job, generator: Generator[Found]) -> None:
            if is_wanted(job):
                at_work[pool.submit(next, generator, _END)] = (job, generator)
            else:
                pool.submit(generator.close)

        while waiting or at_work:
            while waiting and len(at_work) < at_once:
                job = waiting.popleft()
                go_on(job, start(job))
            if not at_work:
                continue
            over, _ = concurrent.futures.wait(
                at_work, return_when=concurrent.futures.FIRST_COMPLETED
            )
            for future in over:
                job, generator = at_work.pop(future)
                found = future.result()
                if found is not _END:
                    yield found
                    del found  # its memory is the caller's alone
                    go_on(job, generator)
