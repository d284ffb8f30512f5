"""Simulations in parallel, each in a thread of its own.

One program's operations are small: if a CPU's cores share each operation, they mostly wait for
each other. Two programs of 8 lanes, one per core, make 1.5 times as many control steps as one
program of 16 (benchmarks/bench_workers.py).
"""

import collections
import concurrent.futures
from collections.abc import Callable, Generator, Iterable, Iterator
from typing import TypeVar

import jax

from starjax.runtime import xla

CPU_LANES = 8  # lanes of a CPU program; the working set of more leaves a core's cache

_END = object()
Job = TypeVar("Job")
Item = TypeVar("Item")


def worker_count() -> int:
    """Returns the number of parallel simulations: one per core of a CPU.

    Other devices run one program each, over which `placement.split` splits the lanes.
    """
    on_cpu = jax.default_backend() == "cpu" and len(jax.local_devices()) == 1
    return xla.cores() if on_cpu else 1


def run(
    jobs: Iterable[Job],
    start: Callable[[Job], Generator[Item]],
    max_workers: int,
    is_needed: Callable[[Job], bool] = lambda job: True,
) -> Iterator[Item]:
    """Yields the items of the jobs' generators as they arrive.

    Args:
      jobs: taken in this order.
      start: makes a job's generator, which runs in one thread at a time.
      max_workers: number of jobs that run in parallel.
      is_needed: called in the caller's thread, before a job begins and after each of its items has
        been taken; it then closes generators of superfluous jobs.
    """
    waiting = collections.deque(jobs)
    running: dict[concurrent.futures.Future, tuple[Job, Generator[Item]]] = {}
    with concurrent.futures.ThreadPoolExecutor(max_workers) as pool:

        def resume(job: Job, generator: Generator[Item]) -> None:
            if is_needed(job):
                running[pool.submit(next, generator, _END)] = (job, generator)
            else:
                pool.submit(generator.close)

        while waiting or running:
            while waiting and len(running) < max_workers:
                job = waiting.popleft()
                resume(job, start(job))
            if not running:
                continue
            done, _ = concurrent.futures.wait(
                running, return_when=concurrent.futures.FIRST_COMPLETED
            )
            for future in done:
                job, generator = running.pop(future)
                item = future.result()
                if item is not _END:
                    yield item
                    del item  # the caller alone holds its memory
                    resume(job, generator)
