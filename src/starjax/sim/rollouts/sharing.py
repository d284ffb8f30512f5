"""Shares out work in one folder among the processes of a run.

Every process runs the same command on a shared folder. Parts are assigned to processes in turn,
and every process reads the others' parts from the folder. Protocol: a process announces an event by
a small JSON file in `<folder>/.shared`, and others poll for it. File names contain the run and the
piece of work, so files of a killed run are ignored. A single process writes none and never waits.
"""

import contextlib
import itertools
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import jax

from starjax.runtime import files, processes

POLL_S = 0.2  # polling interval for other processes' files
_SIGNS = ".shared"

Part = TypeVar("Part")
_works = itertools.count()


class ProcessFailed(files.StorageError):
    """Another process of the run ended with an error."""


class Share(NamedTuple):
    """One process's part in a piece of work.

    Attributes:
      folder: of the work.
      index, count: of this process, and how many there are.
      name: of the piece of work, the same in all processes.
    """

    folder: Path
    index: int
    count: int
    name: str

    @property
    def is_first(self) -> bool:
        """True for the process that does the work of `first`."""
        return self.index == 0

    def mine(self, parts: Sequence[Part]) -> list[Part]:
        """Returns the parts that this process makes."""
        return list(parts[self.index :: self.count])

    def first(self, what: str, act: Callable[[], Any]) -> Any:
        """Runs `act` in the first process and returns its JSON value in all; the others wait."""
        if self.is_first:
            value = act()
            self._sign(what, value)
            return value
        return self._wait(what)

    def meet(self, what: str) -> None:
        """Waits until all processes are here."""
        self._sign(f"{what}-{self.index}", None)
        for index in range(self.count):
            self._wait(f"{what}-{index}")

    def pause(self) -> None:
        """Waits for one polling interval.

        Raises:
          ProcessFailed: one of them ended with an error.
        """
        time.sleep(POLL_S)
        for other in range(self.count):
            if other != self.index:
                with contextlib.suppress(FileNotFoundError):
                    raise ProcessFailed(files.read_json(self._path(_failed(other)))["value"])

    def _path(self, what: str) -> Path:
        return self.folder / _SIGNS / f"{self.name}-{what}.json"

    def _sign(self, what: str, value: Any) -> None:
        if self.count > 1:
            files.write_json(self._path(what), {"value": value})

    def _wait(self, what: str) -> Any:
        path = self._path(what)
        while self.count > 1:
            with contextlib.suppress(FileNotFoundError):
                return files.read_json(path)["value"]
            self.pause()
        return None


ALONE = Share(Path(), 0, 1, "")


@contextlib.contextmanager
def shared(folder: Path) -> Iterator[Share]:
    """Holds `folder` for this run, all of whose processes come here with it.

    Yields:
      The share of this process. The first one's `first` comes before any `meet`.

    Raises:
      StorageError: another run holds it, or the folder cannot be written.
    """
    index, count = jax.process_index(), jax.process_count()
    number = processes.run_number() if count > 1 else 0
    share = Share(folder, index, count, f"{number:x}-{next(_works)}")
    if not share.is_first:
        with _told(share):
            yield share
        share._sign(f"end-{index}", None)
        return
    with files.lock(folder):
        shutil.rmtree(folder / _SIGNS, ignore_errors=True)  # a killed run's
        with _told(share):
            yield share
        for other in range(1, count):
            share._wait(f"end-{other}")
        shutil.rmtree(folder / _SIGNS, ignore_errors=True)


@contextlib.contextmanager
def _told(share: Share) -> Iterator[None]:
    """Tells the others of an error."""
    try:
        yield
    except ProcessFailed:
        raise
    except BaseException as error:
        message = f"process {share.index} of {share.count} ended: {error}"
        share._sign(_failed(share.index), message)
        raise


def _failed(index: int) -> str:
    """Returns the name of the file of a process that ends with an error. Each has its own, because
    processes that are stopped together write at the same time."""
    return f"failed-{index}"
