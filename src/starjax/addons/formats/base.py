"""Interface of all formats: datasets as named columns of episodes."""

import contextlib
import functools
import math
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike

from starjax.addons.formats import file_states
from starjax.addons.formats.file_states import FileState
from starjax.core import errors
from starjax.core.registry import Registry
from starjax.runtime import files, xla

FORMATS = Registry(
    "format",
    {
        "lerobot": "starjax.addons.formats.lerobot:FORMAT",
        "lerobot-v2.1": "starjax.addons.formats.lerobot_v21:FORMAT",
        "aloha": "starjax.addons.formats.aloha:FORMAT",
        "robomimic": "starjax.addons.formats.robomimic:FORMAT",
        "zarr": "starjax.addons.formats.zarr:FORMAT",
        "rosbag": "starjax.addons.formats.rosbag:FORMAT",
        "jigsaws": "starjax.addons.formats.jigsaws:FORMAT",
        "csv": "starjax.addons.formats.csv:FORMAT",
    },
    "starjax.addons.formats.base:Format",
)
OURS = "starjax"  # name of the metadata and columns from which an export is restored
MEMORY_SHARE = 0.25  # part of the host's memory, for one episode
_MAX_HZ = 1e5


class Column(NamedTuple):
    """One column.

    Attributes:
      shape: of one control step.
      dtype: numpy's name, e.g. `float32`.
      names: names of its entries, may be empty.
    """

    shape: tuple[int, ...]
    dtype: str
    names: tuple[str, ...] = ()

    @property
    def is_image(self) -> bool:
        """True for images `[h, w, 3]` uint8."""
        return self.dtype == "uint8" and len(self.shape) == 3 and self.shape[2] == 3


class StepTimes(NamedTuple):
    """Times of an episode's steps, and of the streams that they show.

    Attributes:
      times: `[T]` s.
      ages: stream -> `[T]` s since its value at a step was stamped, infinite before the first.
      periods: stream -> s between its values.
      notes: on clocks that disagree.
    """

    times: np.ndarray
    ages: Mapping[str, np.ndarray]
    periods: Mapping[str, float]
    notes: Sequence[str]


class Source(NamedTuple):
    """A dataset of any format, read an episode at a time.

    Attributes:
      hz: control steps per second; 0 if unknown.
      lengths: control steps of each episode.
      columns: by the format's names.
      read: (episode, names of columns) -> name -> `[T, ...]`.
      origin: metadata of a starjax export, None for other datasets.
      task: description of the task.
      robot: name of the robot.
      notes: anomalies of the files, one per line.
      splits: name -> its episodes, e.g. `train`, `test`, `recovery`, `failure`.
      texts: (episode) -> texts by column: instructions, tools.
      files: () -> of each file by name its bytes, time of change in ns, and digest of its ends.
      faults: episode -> reason why it cannot be read.
      timing: (episode) -> times, of a format whose columns are streams with times of their own.
      by: (columns) -> the source of these streams joined at the first; None if columns are rows.
    """

    hz: float
    lengths: Sequence[int]
    columns: Mapping[str, Column]
    read: Callable[[int, Collection[str]], dict[str, np.ndarray]]
    origin: dict[str, Any] | None = None
    task: str = ""
    robot: str = ""
    notes: Sequence[str] = ()
    splits: Mapping[str, range] = {}
    texts: Callable[[int], Mapping[str, Sequence[str]]] = lambda episode: {}
    files: Callable[[], Mapping[str, FileState]] = dict
    faults: Mapping[int, str] = {}
    timing: Callable[[int], StepTimes] | None = None
    by: "Callable[[Sequence[str]], Source] | None" = None


class Format(NamedTuple):
    """A row of `FORMATS`.

    Attributes:
      description: a line for people.
      named: a column of ours, e.g. `state` or `image_camera` -> as the format's users call it.
      recognises: path -> True if it holds a dataset of this format, judged by file names alone.
      open: (path) -> context with its `Source`. It may raise anything: `open_dataset` explains it.
      write: (path that is not there, Source, video) writes it; `video` is whether images may lose
        a little, where the format has such. None for formats that are read only.
    """

    description: str
    named: Callable[[str], str]
    recognises: Callable[[Path], bool]
    open: Callable[[Path], contextlib.AbstractContextManager[Source]]
    write: Callable[[Path, Source, bool], None] | None = None


def names_in(about: Any, column: str, shape: tuple[int, ...]) -> tuple[str, ...]:
    """Returns the names of a column's entries in a file's metadata, which are not trusted."""
    names = about.get(column) if isinstance(about, dict) else None
    if not isinstance(names, list) or len(names) != math.prod(shape):
        return ()
    return tuple(map(str, names))


def names_of(source: Source) -> dict[str, list[str]]:
    """Returns the names of entries by column, for a file's metadata."""
    return {name: list(column.names) for name, column in source.columns.items() if column.names}


def writable() -> list[str]:
    """Returns the names of formats that exports can have."""
    forms = {name: form for name in FORMATS.names() if (form := _usable(name)) is not None}
    return [name for name, form in forms.items() if form.write is not None]


def detect(path: Path) -> str:
    """Returns the name of the format of the dataset at `path`.

    Raises:
      errors.UsageError: the path does not exist or has an unknown format.
    """
    if not path.exists():
        raise errors.UsageError("PATH", "a dataset", f"{path}, which does not exist")
    for name in FORMATS.names():
        with explained(path, name):
            if _recognises(name, path):
                return name
    raise errors.UsageError("PATH", ", ".join(FORMATS.names()), f"{path} of unknown format")


def _usable(name: str) -> Format | None:
    """Returns a format; None, with a warning, for one that is broken or provided twice."""
    try:
        return FORMATS.get(name)
    except errors.UsageError as error:
        warnings.warn(f"format {name} is skipped: {error}", stacklevel=2)
        return None


def _recognises(name: str, path: Path) -> bool:
    """Returns True if `path` is of a format; False, with a warning, if a package is broken."""
    form = _usable(name)
    try:
        return form is not None and bool(form.recognises(path))
    except Exception as error:
        if name in FORMATS.built_in:
            raise
        warnings.warn(f"format {name} is skipped: {error}", stacklevel=2)
        return False


@contextlib.contextmanager
def open_dataset(path: Path, name: str) -> Iterator[Source]:
    """Opens the dataset of format `name` at `path`; errors of its files become one line.

    Raises:
      errors.UsageError: names the path and the error of the library that reads it.
    """
    form = FORMATS.get(name)
    with contextlib.ExitStack() as stack:
        with explained(path, name):
            source = stack.enter_context(form.open(path))
            require(bool(source.lengths), "episodes", 0)
            require(0.0 <= source.hz < _MAX_HZ, "steps per second", source.hz)

        yield _checked(source._replace(files=functools.partial(file_states.of, path)), path, name)


def _checked(source: Source, path: Path, name: str) -> Source:
    """Returns a source whose readers check their arrays and explain their errors."""

    def read(episode: int, names: Collection[str]) -> dict[str, np.ndarray]:
        for column in names:
            errors.choice("column", column, source.columns)
        with explained(path, name, episode):
            if episode in source.faults:
                raise Damaged(source.faults[episode])
            require(source.lengths[episode] > 0, "control steps", 0)
            _require_all_fit(source, episode, names)
            arrays = source.read(episode, names)
            for column in names:
                _check(column, arrays[column], source, episode)
        return arrays

    def texts(episode: int) -> Mapping[str, Sequence[str]]:
        with explained(path, name, episode):
            return source.texts(episode)

    def timing(episode: int) -> StepTimes:
        assert source.timing is not None
        with explained(path, name, episode):
            return source.timing(episode)

    def by(names: Sequence[str]) -> Source:
        assert source.by is not None
        return _checked(source.by(names), path, name)

    return source._replace(
        read=read, texts=texts, timing=source.timing and timing, by=source.by and by
    )


class Damaged(ValueError):
    """Raised by a format's reader where a file is wrong; becomes the line of `open_dataset`."""


def origin_hz(origin: Mapping[str, Any] | None) -> float:
    """Returns the control steps per second of a starjax export; 0 for other datasets."""
    return float((origin or {}).get("description", {}).get("control_hz", 0.0))


def require(holds: bool, what: str, got: Any) -> None:
    """Raises Damaged unless `holds`."""
    if not holds:
        raise Damaged(f"expected {what}, got {got}")


def require_inside(root: Path, path: Path) -> Path:
    """Returns `path` if it lies in the dataset's folder: names in files are not trusted."""
    roots, real = [root.resolve()], path.resolve()
    if root.absolute().parent.name == "snapshots":  # the Hub's cache: files are links to blobs
        roots.append(root.resolve().parents[1] / "blobs")
    is_inside = any(real.is_relative_to(folder) for folder in roots)
    require(is_inside, f"a path inside {root}", f"a link to {real}" if real != path else path)
    return path


def require_fits(name: str, shape: Sequence[int], dtype: DTypeLike) -> None:
    """Raises Damaged for an array whose header claims more than this machine's memory."""
    count = math.prod(shape) * np.dtype(dtype).itemsize
    max_count = MEMORY_SHARE * xla.memory_bytes()
    require(0 <= count <= max_count, f"at most {files.size(max_count)} an episode of {name}", count)


def _require_all_fit(source: Source, episode: int, names: Collection[str]) -> None:
    """Raises Damaged if the columns together need too much memory."""
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
        raise errors.UsageError(where, f"a sound {name} dataset", reason(error)) from error


def reason(error: Exception) -> str:
    """Returns the message of a library's error as one line."""
    return " ".join(str(error).split())[:200] or type(error).__name__


def _check(name: str, array: np.ndarray, source: Source, episode: int) -> None:
    column, length = source.columns[name], source.lengths[episode]
    shape = (length, *column.shape)
    require(array.shape == shape, f"{name} of shape {list(shape)}", list(array.shape))
    require(array.dtype == column.dtype, f"{name} of {column.dtype}", array.dtype)
