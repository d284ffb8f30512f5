"""Writes a LeRobotDataset v3.0: parquet, videos or PNG, statistics, and its card for a hub."""

import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
from PIL import Image

from starjax import errors
from starjax.data.formats import base, lerobot_card, video
from starjax.data.formats.base import Column, Source
from starjax.runtime import files

DATA_MB, VIDEO_MB, CHUNK = 100, 200, 1000  # sizes of files, files a folder, as LeRobot has them
_COUNTED = {
    "timestamp": "float32",
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",
    "task_index": "int64",
}
_QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
_SAMPLES = 20  # images of an episode whose statistics are taken
_EVERY = 4  # pixels of them


def write(path: Path, source: Source, with_video: bool) -> None:
    """Writes the folder; `with_video` is whether images go into videos, else into PNG."""
    hz = round(source.hz)
    if hz != source.hz or hz < 1:
        raise errors.UsageError("DATASET", "a whole number of steps per second", source.hz)
    features = _features(source, hz, with_video)
    cameras = [name for name, column in source.columns.items() if column.is_image]
    tables = _Files(path, "data", "parquet", DATA_MB)
    videos = {
        name: _Files(path, f"videos/{name}", "mp4", VIDEO_MB) for name in cameras if with_video
    }
    rows, samples, first = [], {}, 0
    for episode, length in enumerate(source.lengths):
        arrays = source.read(episode, source.columns)
        arrays |= _counted(episode, length, first, hz)
        row = {"episode_index": episode, "tasks": [source.task], "length": length}
        row |= {"dataset_from_index": first, "dataset_to_index": first + length}
        row |= {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
        for name, files_of_camera in videos.items():
            row |= _append_images(files_of_camera, name, arrays[name], hz)
        row |= _append_rows(tables, features, arrays)
        # Videos come first: the order of the columns is part of the file.
        for name in [*videos, *(name for name in arrays if name not in videos)]:
            array = _sampled(arrays[name]) if name in cameras else arrays[name]
            row |= {f"stats/{name}/{key}": value for key, value in _stats(array).items()}
            samples.setdefault(name, []).append(array)
        rows.append(row)
        first += length
    for some in (tables, *videos.values()):
        some.close()
    _meta(path, source, features, rows, samples, hz)


class _Files:
    """Files of at most `max_mb`, until the next episode, one after another as LeRobot has them."""

    def __init__(self, root: Path, kind: str, ending: str, max_mb: int):
        self._root, self._kind, self._ending, self._max_bytes = root, kind, ending, max_mb * 1e6
        self._writer: Any = None
        self._path, self._count = root, -1

    def writer(self, open_file: Callable[[Path], Any]) -> Any:
        """Returns the writer of the present file, or of the next one if that is full."""
        if self._writer and self._path.stat().st_size > self._max_bytes:
            self.close()
        if self._writer is None:
            self._count += 1
            chunk, file = divmod(self._count, CHUNK)
            name = f"chunk-{chunk:03d}/file-{file:03d}.{self._ending}"
            self._path = self._root / self._kind / name
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = open_file(self._path)
        return self._writer

    def place(self) -> dict[str, int]:
        """Returns the columns that locate the present file."""
        chunk, file = divmod(self._count, CHUNK)
        return {f"{self._kind}/chunk_index": chunk, f"{self._kind}/file_index": file}

    def close(self) -> None:
        """Ends the present file."""
        self._writer.close()
        self._writer = None


def _append_rows(
    tables: _Files, features: dict[str, Any], arrays: dict[str, np.ndarray]
) -> dict[str, int]:
    """Writes the numbers of an episode as one row group of data/*; returns its place."""
    names = [name for name, feature in features.items() if feature["dtype"] != "video"]
    table = pa.table({name: _cells(arrays[name], features[name]) for name in names})
    described = {name: _described(features[name]) for name in names}
    text = json.dumps({"info": {"features": described}})
    table = table.replace_schema_metadata({"huggingface": text})
    tables.writer(lambda path: parquet.ParquetWriter(path, table.schema)).write_table(table)
    return tables.place()


def _append_images(videos: _Files, name: str, images: np.ndarray, hz: int) -> dict[str, Any]:
    """Writes the images of an episode to videos/<camera>/*; returns their place."""
    writer = videos.writer(lambda path: video.Writer(path, images.shape[1:], hz))
    start = writer.seconds
    writer.append(images)
    times = {"from_timestamp": start, "to_timestamp": writer.seconds}
    return videos.place() | {f"videos/{name}/{key}": time for key, time in times.items()}


def _features(source: Source, hz: int, with_video: bool) -> dict[str, Any]:
    columns = {name: Column((1,), dtype) for name, dtype in _COUNTED.items()}
    return {
        name: _picture(column, hz, with_video) if column.is_image else _feature(column)
        for name, column in {**source.columns, **columns}.items()
    }


def _feature(column: Column) -> dict[str, Any]:
    """Describes a column as a flat vector per step, the only shape that other tools read."""
    count = int(np.prod(column.shape))
    return {"dtype": column.dtype, "shape": [count], "names": list(column.names) or None}


def _picture(column: Column, hz: int, with_video: bool) -> dict[str, Any]:
    shape = list(column.shape)
    feature = {"dtype": "image", "shape": shape, "names": ["height", "width", "channels"]}
    if not with_video:
        return feature
    about = {
        "video.height": shape[0],
        "video.width": shape[1],
        "video.codec": video.CODEC,
        "video.pix_fmt": video.PIXELS,
        "video.is_depth_map": False,
        "video.fps": hz,
        "video.channels": 3,
        "has_audio": False,
    }
    return feature | {"dtype": "video", "info": about}


def _counted(episode: int, length: int, first: int, hz: int) -> dict[str, np.ndarray]:
    steps = np.arange(length)
    arrays = {
        "timestamp": steps / hz,
        "frame_index": steps,
        "episode_index": np.full(length, episode),
        "index": first + steps,
        "task_index": np.zeros(length),
    }
    return {name: array.astype(_COUNTED[name]) for name, array in arrays.items()}


def _cells(array: np.ndarray, feature: dict[str, Any]) -> pa.Array:
    if feature["dtype"] == "image":
        kind = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
        names = (f"frame-{i:06d}.png" for i in range(len(array)))
        return pa.array([{"bytes": _png(x), "path": name} for x, name in zip(array, names)], kind)
    flat = pa.array(np.ascontiguousarray(array).reshape(-1))
    count = feature["shape"][0]
    return flat if count == 1 else pa.FixedSizeListArray.from_arrays(flat, count)


def _png(image: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG", compress_level=1)
    return buffer.getvalue()


def _described(feature: dict[str, Any]) -> dict[str, Any]:
    """Converts a feature to the notation of the package datasets."""
    if feature["dtype"] == "image":
        return {"_type": "Image"}
    value = {"dtype": feature["dtype"], "_type": "Value"}
    count = feature["shape"][0]
    return value if count == 1 else {"feature": value, "length": count, "_type": "List"}


def _sampled(images: np.ndarray) -> np.ndarray:
    chosen = np.linspace(0, len(images) - 1, min(len(images), _SAMPLES)).astype(int)
    return images[chosen][:, ::_EVERY, ::_EVERY]


def _stats(array: np.ndarray) -> dict[str, list]:
    is_image = array.ndim == 4 and array.dtype == np.uint8
    rows = array.reshape(-1, 3) / 255.0 if is_image else array.reshape(len(array), -1)
    rows = np.where(np.isfinite(rows), rows, 0.0)  # JSON has no other numbers
    figures = {"min": rows.min(0), "max": rows.max(0), "mean": rows.mean(0), "std": rows.std(0)}
    figures |= dict(zip(_QUANTILES, np.quantile(rows, list(_QUANTILES.values()), axis=0)))
    shape = (3, 1, 1) if is_image else (-1,)
    return {n: x.reshape(shape).tolist() for n, x in figures.items()} | {"count": [len(array)]}


def _meta(
    path: Path,
    source: Source,
    features: dict[str, Any],
    rows: list[dict[str, Any]],
    samples: dict[str, list[np.ndarray]],
    hz: int,
) -> None:
    index = path / "meta/episodes/chunk-000/file-000.parquet"
    index.parent.mkdir(parents=True)
    parquet.write_table(pa.Table.from_pylist(rows), index)
    parquet.write_table(_tasks(source.task), path / "meta/tasks.parquet")
    stats = {name: _stats(np.concatenate(parts)) for name, parts in samples.items()}
    files.write_json(path / "meta/stats.json", stats)
    has_video = any(feature["dtype"] == "video" for feature in features.values())
    place = "chunk-{chunk_index:03d}/file-{file_index:03d}"
    about = {
        "codebase_version": "v3.0",
        "robot_type": source.robot,
        "total_episodes": len(rows),
        "total_frames": sum(source.lengths),
        "total_tasks": 1,
        "chunks_size": CHUNK,
        "data_files_size_in_mb": DATA_MB,
        "video_files_size_in_mb": VIDEO_MB,
        "fps": hz,
        "splits": {"train": f"0:{len(rows)}"},
        "data_path": f"data/{place}.parquet",
        "video_path": f"videos/{{video_key}}/{place}.mp4" if has_video else None,
        "features": features,
    }
    files.write_json(path / "meta/info.json", about)
    if source.origin:
        files.write_json(path / "meta" / f"{base.OURS}.json", source.origin)
    (path / "README.md").write_text(lerobot_card.card(about, source))


def _tasks(task: str) -> pa.Table:
    """Returns the table of tasks as pandas writes it, with the text as index."""
    table = pa.table({"task_index": pa.array([0]), "task": pa.array([task])})
    number = {"pandas_type": "int64", "numpy_type": "int64", "metadata": None}
    words = {"pandas_type": "unicode", "numpy_type": "object", "metadata": None}
    metadata = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": [
            {"name": "task_index", "field_name": "task_index", **number},
            {"name": "task", "field_name": "task", **words},
        ],
        "creator": {"library": "pyarrow", "version": pa.__version__},
        "pandas_version": "2.2.0",
    }
    return table.replace_schema_metadata({"pandas": json.dumps(metadata)})
