"""Writes a LeRobotDataset v3.0: parquet, videos or PNG, statistics, and its card for a hub."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet

from starjax.addons.formats import base, lerobot_card, lerobot_tables, video
from starjax.addons.formats.base import Source
from starjax.runtime import files

DATA_MB, VIDEO_MB = 100, 200  # sizes of files, as LeRobot has them


def write(path: Path, source: Source, with_video: bool) -> None:
    """Writes the folder; `with_video` is whether images go into videos, else into PNG."""
    hz = lerobot_tables.whole_hz(source)
    features = lerobot_tables.features(source, hz, with_video)
    cameras = [name for name, column in source.columns.items() if column.is_image]
    tables = _Files(path, "data", "parquet", DATA_MB)
    videos = {
        name: _Files(path, f"videos/{name}", "mp4", VIDEO_MB) for name in cameras if with_video
    }
    rows, samples, first = [], {}, 0
    for episode, length in enumerate(source.lengths):
        arrays = source.read(episode, source.columns)
        arrays |= lerobot_tables.counted(episode, length, first, hz)
        row = {"episode_index": episode, "tasks": [source.task], "length": length}
        row |= {"dataset_from_index": first, "dataset_to_index": first + length}
        row |= {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
        for name, files_of_camera in videos.items():
            row |= _append_images(files_of_camera, name, arrays[name], hz)
        row |= _append_rows(tables, features, arrays)
        # Videos come first: the order of the columns is part of the file.
        for name in [*videos, *(name for name in arrays if name not in videos)]:
            array = lerobot_tables.sampled(arrays[name]) if name in cameras else arrays[name]
            figures = lerobot_tables.stats(array)
            row |= {f"stats/{name}/{key}": value for key, value in figures.items()}
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
            chunk, file = divmod(self._count, lerobot_tables.CHUNK)
            name = f"chunk-{chunk:03d}/file-{file:03d}.{self._ending}"
            self._path = self._root / self._kind / name
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = open_file(self._path)
        return self._writer

    def place(self) -> dict[str, int]:
        """Returns the columns that locate the present file."""
        chunk, file = divmod(self._count, lerobot_tables.CHUNK)
        return {f"{self._kind}/chunk_index": chunk, f"{self._kind}/file_index": file}

    def close(self) -> None:
        """Ends the present file."""
        self._writer.close()
        self._writer = None


def _append_rows(
    tables: _Files, features: dict[str, Any], arrays: dict[str, np.ndarray]
) -> dict[str, int]:
    """Writes the numbers of an episode as one row group of data/*; returns its place."""
    table = lerobot_tables.table(features, arrays)
    tables.writer(lambda path: parquet.ParquetWriter(path, table.schema)).write_table(table)
    return tables.place()


def _append_images(videos: _Files, name: str, images: np.ndarray, hz: int) -> dict[str, Any]:
    """Writes the images of an episode to videos/<camera>/*; returns their place."""
    writer = videos.writer(lambda path: video.Writer(path, images.shape[1:], hz))
    start = writer.seconds
    writer.append(images)
    times = {"from_timestamp": start, "to_timestamp": writer.seconds}
    return videos.place() | {f"videos/{name}/{key}": time for key, time in times.items()}


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
    stats = {name: lerobot_tables.stats(np.concatenate(parts)) for name, parts in samples.items()}
    files.write_json(path / "meta/stats.json", stats)
    has_video = any(feature["dtype"] == "video" for feature in features.values())
    place = "chunk-{chunk_index:03d}/file-{file_index:03d}"
    about = {
        "codebase_version": "v3.0",
        "robot_type": source.robot,
        "total_episodes": len(rows),
        "total_frames": sum(source.lengths),
        "total_tasks": 1,
        "chunks_size": lerobot_tables.CHUNK,
        "data_files_size_in_mb": DATA_MB,
        "video_files_size_in_mb": VIDEO_MB,
        "fps": hz,
        "splits": lerobot_tables.splits(source),
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
