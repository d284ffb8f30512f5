"""Common ground of all formats: datasets as named columns of episodes, records of functions."""

import contextlib
import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from starjax import errors
from starjax.registry import Registry
from starjax.runtime import files, xla

FORMATS = Registry(
    "format",
    {
        "lerobot": "starjax.data.formats.lerobot:FORMAT",
        "robomimic": "starjax.data.formats.robomimic:FORMAT",
        "zarr": "starjax.data.formats.zarr:FORMAT",
    },
)
OURS = "starjax"  # name of what an export adds so that it comes back whole
MEMORY_SHARE = 0.25  # of the host's, that what is read of one episode may take
_MOST_HZ = 1e5


class Column(NamedTuple):
    """One column.

    Attributes:
      shape: of one control step.
      dtype: numpy's name, e.g. `float32`.
      names: of its numbers, empty where nobody has named them.
    """

    shape: tuple[int, ...]
    dtype: str
    names: tuple[str, ...] = ()

    @property
    def is_image(self) -> bool:
        """Whether its steps are pictures, `[h, w, 3]` uint8."""
        return self.dtype == "uint8" and len(self.shape) == 3 and self.shape[2] == 3


class Source(NamedTuple):
    """A dataset of any format, read an episode at a time.

    Attributes:
      hz: control steps a second; 0 where nobody says.
      lengths: control steps of each episode.
      columns: by the names that the format calls them.
      read: (episode, names of columns) -> name -> `[T, ...]`.
      origin: what `exchange.origin` says of an export of ours, None of other people's files.
      task: what is done, in words. robot: who does it.
      notes: what is odd about the files, a line each.
    """

    hz: float
    lengths: Sequence[int]
    columns: Mapping[str, Column]
    read: Callable[[int, Collection[str]], dict[str, np.ndarray]]
    origin: dict[str, Any] | None = None
    task: str = ""
    robot: str = ""
    notes: Sequence[str] = ()


class Format(NamedTuple):
    """A row of `FORMATS`.

    Attributes:
      description: a line for people.
      named: a column of ours, e.g. `state` or `image_camera` -> as the format's users call it.
      recognises: whether a path holds a dataset of it, by a look at names alone.
      open: (path) -> context with its `Source`. It may raise anything: `open_dataset` explains it.
      write: (path that is not there, Source, video) writes it; `video` is whether images may lose
        a little, where the format has such.
    """

    description: str
    named: Callable[[str], str]
    recognises: Callable[[Path], bool]
    open: Callable[[Path], contextlib.AbstractContextManager[Source]]
    write: Callable[[Path, Source, bool], None]


def detect(path: Path) -> str:
    """Name of the format of what lies at `path`.

    Raises:
      errors.UsageError: nothing lies there, or nothing that a format knows.
    """
    if not path.exists():
        raise errors.UsageError("PATH", "a dataset", f"{path}: nothing is there")
    found = [name for name in FORMATS.names() if FORMATS.get(name).recognises(path)]
    if not found:
        known = ", ".join(FORMATS.names())
        raise errors.UsageError("PATH", f"a dataset of {known}", f"{path}: none of them")
    return found[0]


@contextlib.contextmanager
def open_dataset(path: Path, name: str) -> Iterator[Source]:
    """The dataset of format `name` at `path`; what is wrong with its files is one line.

    Raises:
      errors.UsageError: naming the path, and what the library that reads it says.
    """
    form = FORMATS.get(name)
    with contextlib.ExitStack() as stack:
        with explained(path, name):
            source = stack.enter_context(form.open(path))
            require(bool(source.lengths), "episodes", 0)
            require(0.0 <= source.hz < _MOST_HZ, "steps a second", source.hz)

        def read(episode: int, names: Collection[str]) -> dict[str, np.ndarray]:
            for column in names:
                errors.choice("column", column, source.columns)
            with explained(path, name, episode):
                _require_all_fit(source, episode, names)
                found = source.read(episode, names)
                for column in names:
                    _check(column, found[column], source, episode)
            return found

        yield source._replace(read=read)


class Damaged(ValueError):
    """Raised by a format's reader where a file is wrong; becomes the line of `open_dataset`."""


def require(holds: bool, what: str, got: Any) -> None:
    """Raises Damaged, for a reader, unless `holds`."""
    if not holds:
        raise Damaged(f"expected {what}, got {got}")


def require_inside(root: Path, path: Path) -> Path:
    """A file of a dataset that lies in its folder: names in files are not trusted."""
    require(path.resolve().is_relative_to(root.resolve()), f"a path inside {root}", path)
    return path


def require_fits(name: str, shape: Sequence[int], dtype: Any) -> None:
    """Raises Damaged for an array that a file only claims, larger than this machine can hold."""
    count = math.prod(shape) * np.dtype(dtype).itemsize
    most = MEMORY_SHARE * xla.memory_bytes()
    require(0 <= count <= most, f"at most {files.size(most)} an episode of {name}", count)


def _require_all_fit(source: Source, episode: int, names: Collection[str]) -> None:
    """Raises Damaged where columns, none of them too large, are so together."""
    columns = [source.columns[name] for name in names]
    row = sum(math.prod(c.shape) * np.dtype(c.dtype).itemsize for c in columns)
    require_fits("all columns", (source.lengths[episode], row), np.uint8)


@contextlib.contextmanager
def explained(path: Path, name: str, episode: int | None = None) -> Iterator[None]:
    """Turns whatever a library raises over a bad file into one line."""
    try:
        yield
    except (errors.UsageError, files.StorageError):
        raise
    # Damaged files make these libraries raise nearly anything.
    except Exception as error:
        where = f"{path}" if episode is None else f"{path}, episode {episode}"
        said = " ".join(str(error).split())[:200] or type(error).__name__
        raise errors.UsageError(where, f"a sound {name} dataset", said) from error


def _check(name: str, array: np.ndarray, source: Source, episode: int) -> None:
    column, length = source.columns[name], source.lengths[episode]
    wanted = (length, *column.shape)
    require(array.shape == wanted, f"{name} of shape {list(wanted)}", list(array.shape))
    require(array.dtype == column.dtype, f"{name} of {column.dtype}", array.dtype)
