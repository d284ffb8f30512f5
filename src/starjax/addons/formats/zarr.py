"""Diffusion Policy's replay buffer: a zarr folder (version 2) of all episodes one after another.

data/<name>         [F, ...], chunked along time
meta/episode_ends   [E] int64, first frame after each episode
"""

import contextlib
import itertools
import json
import math
import zipfile
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

import numcodecs
import numcodecs.errors
import numpy as np
import zarr

from starjax.addons.formats import base
from starjax.addons.formats.base import Column, Source
from starjax.runtime import files

_CHUNK_BYTES = 2_000_000  # as Diffusion Policy has them
_MAX_CHUNKS = 1_000_000  # for a column of an episode


def named(column: str) -> str:
    """Returns Diffusion Policy's name of a starjax column: the same."""
    return column


@contextlib.contextmanager
def _open(path: Path) -> Iterator[Source]:
    with _storage(path) as (storage, names, about):
        # One array at a time: a group of which one is damaged may leave zarr's own loop waiting.
        whole = _array(storage, "meta/episode_ends")
        _require_readable("episode_ends", whole, whole.shape)
        ends = np.asarray(whole[:], np.int64)
        rises = ends.ndim == 1 and len(ends) > 0 and bool((np.diff(ends, prepend=0) >= 0).all())
        base.require(rises, "episode_ends that rise", ends.tolist()[:5])
        starts = np.concatenate([[0], ends[:-1]])
        arrays, notes = {}, []
        for name in names:
            try:
                arrays[name] = _array(storage, f"data/{name}")
            except numcodecs.errors.UnknownCodecError as error:
                notes.append(f"{name}: {error}; omitted")
        arrays = {name: array for name, array in arrays.items() if array.dtype.kind in "biuf"}
        for name, array in arrays.items():
            whole = array.ndim > 0 and array.shape[0] == ends[-1]
            base.require(whole, f"{ends[-1]} frames of {name}", list(array.shape))
        columns = {
            name: Column(
                tuple(array.shape[1:]),
                array.dtype.name,
                base.names_in(about.get("names"), name, array.shape[1:]),
            )
            for name, array in arrays.items()
        }

        def read(episode: int, names: Collection[str]) -> dict[str, np.ndarray]:
            first, last = int(starts[episode]), int(ends[episode])
            for name in names:
                _require_readable(name, arrays[name], (last - first, *columns[name].shape))
                if isinstance(storage, Path):  # an archive that lacks a part does not open
                    folder = storage / "data" / name
                    _require_chunks(folder, arrays[name], columns[name], range(first, last))
            return {name: np.asarray(arrays[name][first:last]) for name in names}

        origin = about.get(base.OURS)
        hz = base.origin_hz(origin) or float(about.get("hz", 0.0))
        lengths, task = (ends - starts).tolist(), str(about.get("task", ""))
        splits = {name: range(*ends) for name, ends in about.get("splits", {}).items()}
        robot = str(about.get("robot", ""))
        yield Source(hz, lengths, columns, read, origin, task, robot, notes, splits)


@contextlib.contextmanager
def _storage(path: Path) -> Iterator[tuple[Any, list[str], dict[str, Any]]]:
    """Opens a folder or zip: yields the storage, the names of columns, the attributes."""
    if path.is_dir():
        for inside in path.rglob("*"):
            base.require(not inside.is_symlink(), "no links", inside)
        names = sorted(folder.name for folder in (path / "data").glob("*/"))
        attributes = path / ".zattrs"
        yield path, names, files.read_json(attributes) if attributes.exists() else {}
        return
    with zipfile.ZipFile(path) as archive:
        for member in archive.infolist():  # a small one may unpack to gigabytes
            base.require_fits(member.filename, (member.file_size,), np.uint8)
        parts = [name.split("/") for name in archive.namelist()]
        names = sorted({part[1] for part in parts if part[0] == "data" and len(part) > 2})
        has_attributes = ".zattrs" in archive.namelist()
        about = json.loads(archive.read(".zattrs")) if has_attributes else {}
        base.require(isinstance(about, dict), "a map of attributes", type(about).__name__)
    with contextlib.closing(zarr.storage.ZipStore(path, mode="r")) as storage:
        yield storage, names, about


def _write(path: Path, source: Source, video: bool) -> None:
    root: Any = zarr.open_group(str(path), mode="w", zarr_format=2)
    frames = sum(source.lengths)
    data, meta = root.create_group("data"), root.create_group("meta")
    packed = numcodecs.Blosc(cname="zstd", clevel=5, shuffle=numcodecs.Blosc.BITSHUFFLE)
    arrays = {}
    for name, column in source.columns.items():
        step = int(np.prod(column.shape)) * np.dtype(column.dtype).itemsize
        rows = 1 if column.is_image else max(1, min(frames, _CHUNK_BYTES // step))
        arrays[name] = data.create_array(
            name,
            shape=(frames, *column.shape),
            chunks=(rows, *column.shape),
            dtype=column.dtype,
            compressors=packed,
            config={"write_empty_chunks": True},
        )
    buffers = {name: _Buffer(array) for name, array in arrays.items()}
    for episode in range(len(source.lengths)):
        for name, array in source.read(episode, source.columns).items():
            buffers[name].append(array)
    for buffer in buffers.values():
        buffer.flush()
    ends = np.cumsum(source.lengths, dtype=np.int64)
    meta.create_array("episode_ends", data=ends, compressors=None)
    splits = {name: [part.start, part.stop] for name, part in source.splits.items()}
    about = {"hz": source.hz, "names": base.names_of(source), "task": source.task}
    root.attrs.update(about | {"robot": source.robot, "splits": splits, base.OURS: source.origin})


class _Buffer:
    """Appends to an array in whole chunks, which never reads a chunk back."""

    def __init__(self, array: zarr.Array):
        self._array, self._parts, self._held, self._at = array, [], 0, 0

    def append(self, part: np.ndarray) -> None:
        """Takes rows that follow the last ones."""
        self._parts.append(part)
        self._held += len(part)
        rows = self._array.chunks[0]
        if self._held >= rows:
            self._store(self._held - self._held % rows)

    def flush(self) -> None:
        """Stores the rest."""
        if self._held:
            self._store(self._held)

    def _store(self, count: int) -> None:
        whole = np.concatenate(self._parts)
        self._array[self._at : self._at + count] = whole[:count]
        self._parts, self._held, self._at = [whole[count:]], self._held - count, self._at + count


def _array(storage: Any, name: str) -> Any:
    if isinstance(storage, Path):
        return zarr.open_array(str(storage / name), mode="r")
    return zarr.open_array(storage, path=name, mode="r")


def _require_readable(name: str, array: zarr.Array, shape: Sequence[int]) -> None:
    """Raises Damaged for sizes that a damaged header claims, in numbers or in chunks."""
    base.require(min(array.chunks, default=1) > 0, f"chunks of {name}", list(array.chunks))
    base.require_fits(name, shape, array.dtype)
    base.require_fits(f"{name}'s chunks", array.chunks, array.dtype)
    count = math.prod(-(-size // chunk) for size, chunk in zip(shape, array.chunks))
    base.require(count <= _MAX_CHUNKS, f"{_MAX_CHUNKS} chunks of {name} at most", count)


def _require_chunks(folder: Path, array: zarr.Array, column: Column, rows: range) -> None:
    """Raises Damaged for files that rows need and that are cut, or those of images, missing.

    A missing one reads as zeros, which writers may leave out; Blosc reads beyond a cut one.
    """
    is_blosc = [type(one).__name__.startswith("Blosc") for one in array.compressors] == [True]
    if array.shards or not (is_blosc or column.is_image) or not rows:
        return
    first, last = rows[0] // array.chunks[0], rows[-1] // array.chunks[0]
    counts = [-(-size // chunk) for size, chunk in zip(array.shape, array.chunks)]
    for place in itertools.product(range(first, last + 1), *map(range, counts[1:])):
        file = folder / array.metadata.encode_chunk_key(place)
        is_there = file.is_file()
        base.require(is_there or not column.is_image, f"a file {file}", "none")
        if is_there and is_blosc:
            with open(file, "rb") as chunk:
                size = int.from_bytes(chunk.read(16)[12:], "little")  # last field of the header
            base.require(
                file.stat().st_size == size, f"{size} bytes in {file}", file.stat().st_size
            )


def _recognises(path: Path) -> bool:
    if path.is_file():
        return path.name.endswith(".zarr.zip")
    return (path / ".zgroup").is_file() or (path / "zarr.json").is_file()


FORMAT = base.Format("zarr of Diffusion Policy, also .zarr.zip", named, _recognises, _open, _write)
