"""Makes the missing parts of a job, which are files of arrays, and reads the others.

Files are written atomically and have checksums: after a kill, the same command makes the missing
parts, and names damaged ones and makes them again. Parts are split over the processes of a run,
and every process reads all of them.
"""

import contextlib
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from starjax.runtime import files, progress
from starjax.sim.rollouts import workers
from starjax.sim.rollouts.sharing import Share

Arrays = dict[str, np.ndarray]


class Parts(NamedTuple):
    """A job.

    Attributes:
      paths: the file of each part.
      sizes: units of each, e.g. trials, for the progress.
      check: (number, arrays) -> raises ValueError if they are not those of this part.
      make: number -> a generator that yields the units done in between and returns the arrays.
    """

    paths: Sequence[Path]
    sizes: Sequence[int]
    check: Callable[[int, Arrays], None]
    make: Callable[[int], Generator[float, None, Arrays]]


def complete(
    share: Share, parts: Parts, title: str, unit: str, report: Callable[[str], None]
) -> list[Arrays]:
    """Makes this process's parts that are missing; returns all parts.

    Args:
      title, unit: of the progress that the first process shows, e.g. Evaluation and trials.
      report: called with a line per damaged part.

    Raises:
      StorageError: a part cannot be written.
      ValueError: a part of another process is damaged as soon as it was written.
    """
    numbers = range(len(parts.paths))
    mine = share.mine(numbers)
    found: dict[int, Arrays | None] = {number: _read(parts, number, report) for number in mine}
    missing = [number for number in mine if found[number] is None]

    def work(number: int) -> Generator[float]:
        arrays = yield from parts.make(number)
        files.write_npz(parts.paths[number], arrays)
        found[number] = arrays

    with _shown(share, parts, mine, missing, title, unit) as advance:
        for passed in workers.run(missing, work, workers.worker_count()):
            advance(passed)
    share.meet("made")
    return [found.get(number) or _checked(parts, number) for number in numbers]


def _checked(parts: Parts, number: int) -> Arrays:
    path = parts.paths[number]
    arrays = files.read_npz(path)
    try:
        parts.check(number, arrays)
    except ValueError as error:
        raise ValueError(f"{path} is damaged: {error}") from error
    return arrays


def _read(parts: Parts, number: int, report: Callable[[str], None]) -> Arrays | None:
    """Reads a finished part; returns None if it is missing or damaged."""
    try:
        return _checked(parts, number)
    except FileNotFoundError:
        return None
    except ValueError as error:
        report(f"{error}; made again")
        return None


def _shown(
    share: Share, parts: Parts, mine: list[int], missing: list[int], title: str, unit: str
) -> contextlib.AbstractContextManager[Any]:
    if not share.is_first:
        return contextlib.nullcontext(lambda units: None)
    total, left = (sum(parts.sizes[number] for number in some) for some in (mine, missing))
    among = f", process 1 of {share.count}" if share.count > 1 else ""
    return progress.track(f"{title}{among}", total, unit=unit, done=total - left)
