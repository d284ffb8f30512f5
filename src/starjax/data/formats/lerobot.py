"""LeRobotDataset: written as v3.0, read as v3.0 and v2.1. Nothing of lerobot is needed.

v3.0 has episodes one after another in files of about 100 MB, v2.1 a file an episode:

    meta/info.json                     fps, features
    meta/episodes/*/*.parquet          lengths, and where each lies (v2.1: meta/episodes.jsonl)
    data/chunk-000/file-000.parquet    numbers, and images as PNG (v2.1: episode_000000.parquet)
    videos/<camera>/chunk-000/...      images as video (v2.1: videos/chunk-000/<camera>/...)
    meta/starjax.json                  of our exports: what they need to come back whole

Templates of paths in info.json are untrusted and not used.
"""

import contextlib
import io
import json
import re
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.dataset as datasets
import pyarrow.parquet as parquet
from PIL import Image

from starjax.data.formats import base, lerobot_write, video
from starjax.data.formats.base import Column, Source
from starjax.rollouts import episodes
from starjax.runtime import files

_NAMES = {
    "state": "observation.state",
    "trocar": "observation.trocar",
    "environment_state": "observation.environment_state",
    "reward": "next.reward",
    "done": "next.done",
}
_FEATURE = re.compile(r"[\w.][\w.\- ]*")  # a feature's name, which is also a folder's
_CHUNK = 1000  # files a folder, where v2.1 does not say


def named(column: str) -> str:
    """Returns LeRobot's name of a starjax column."""
    if column.startswith(episodes.IMAGE):
        return f"observation.images.{column.removeprefix(episodes.IMAGE)}"
    return _NAMES.get(column, column)


class _Place(NamedTuple):
    """Files of an episode: its number, its table, and each camera's video and start time."""

    number: int
    length: int
    table: Path
    videos: dict[str, tuple[Path, float]]


@contextlib.contextmanager
def _open(path: Path) -> Iterator[Source]:
    info = files.read_json(path / "meta/info.json")
    version = str(info["codebase_version"])
    base.require(version[:3] in _READERS, "version v3.0 or v2.1", version)
    hz = float(info["fps"])
    base.require(0.0 < hz < 1e5, "fps above 0", hz)
    columns, kinds = {}, {}
    for name, feature in info["features"].items():
        base.require(bool(_FEATURE.fullmatch(name)) and ".." not in name, "a name", name)
        if (column := _column(feature)) is not None:
            columns[name], kinds[name] = column, feature["dtype"]
    cameras = [name for name, kind in kinds.items() if kind == "video"]
    places = list(_READERS[version[:3]](path, info, cameras))

    def read(episode: int, names: Collection[str]) -> dict[str, np.ndarray]:
        place = places[episode]
        numeric = [name for name in names if kinds[name] != "video"]
        table = _rows(path, place, numeric)
        arrays = {
            name: _array(name, table[name], columns[name], kinds[name], place.length)
            for name in numeric
        }
        for name in names:
            if kinds[name] == "video":
                file, first = place.videos[name]
                base.require_inside(path, file)
                arrays[name] = video.read(file, first, place.length, hz, columns[name].shape)
        return arrays

    ours = path / "meta" / f"{base.OURS}.json"
    origin = files.read_json(ours) if ours.exists() else None
    robot = str(info.get("robot_type") or "")
    yield Source(hz, [p.length for p in places], columns, read, origin, _task(path), robot)


def _column(feature: dict[str, Any]) -> Column | None:
    """Converts a feature to a column; returns None for text."""
    kind, shape = feature["dtype"], tuple(int(n) for n in feature["shape"])
    base.require(all(n > 0 for n in shape), "sizes above 0", list(shape))
    if kind in ("image", "video"):
        base.require(len(shape) == 3, "[h, w, 3]", list(shape))
        first = shape[0] == 3 and shape[2] != 3
        return Column((*shape[1:], 3) if first else shape, "uint8")
    if kind == "string":
        return None
    names = feature.get("names")
    names = next(iter(names.values())) if isinstance(names, dict) and names else names
    named = tuple(map(str, names)) if isinstance(names, list) else ()
    return Column(() if shape == (1,) else shape, np.dtype(kind).name, named)


def _places_v3(root: Path, info: dict[str, Any], cameras: list[str]) -> Iterator[_Place]:
    paths = sorted((root / "meta/episodes").glob("*/*.parquet"))
    base.require(bool(paths), "meta/episodes/*/*.parquet", "none")
    for path in paths:
        table = parquet.read_table(base.require_inside(root, path))
        names = [name for name in table.column_names if not name.startswith("stats/")]
        for row in table.select(names).to_pylist():
            videos = {
                name: (
                    root / "videos" / name / _file(row, f"videos/{name}", "mp4"),
                    float(row[f"videos/{name}/from_timestamp"]),
                )
                for name in cameras
            }
            number = int(row["episode_index"])
            length = _length(row["length"])
            yield _Place(number, length, root / "data" / _file(row, "data", "parquet"), videos)


def _file(row: dict[str, Any], kind: str, ending: str) -> str:
    chunk, file = int(row[f"{kind}/chunk_index"]), int(row[f"{kind}/file_index"])
    return f"chunk-{chunk:03d}/file-{file:03d}.{ending}"


def _places_v2(root: Path, info: dict[str, Any], cameras: list[str]) -> Iterator[_Place]:
    size = int(info.get("chunks_size") or _CHUNK)
    for row in _json_lines(root / "meta/episodes.jsonl"):
        number = int(row["episode_index"])
        base.require(number >= 0, "an episode's number", number)
        chunk, name = f"chunk-{number // size:03d}", f"episode_{number:06d}"
        videos = {
            camera: (root / "videos" / chunk / camera / f"{name}.mp4", 0.0) for camera in cameras
        }
        table = root / "data" / chunk / f"{name}.parquet"
        yield _Place(number, _length(row["length"]), table, videos)


_READERS: dict[str, Callable[[Path, dict[str, Any], list[str]], Iterator[_Place]]] = {
    "v3.": _places_v3,
    "v2.": _places_v2,
}


def _length(value: Any) -> int:
    base.require(0 < int(value) < 10**8, "control steps", value)
    return int(value)


def _rows(root: Path, place: _Place, names: list[str]) -> Any:
    """Reads the rows of an episode; statistics let parquet skip other row groups."""
    if not names:
        return {}
    base.require(place.table.is_file(), "a file of numbers", f"none at {place.table}")
    table = datasets.dataset(base.require_inside(root, place.table), format="parquet")
    is_its = datasets.field("episode_index") == place.number
    order = "frame_index" if "frame_index" in table.schema.names else "episode_index"
    columns = dict.fromkeys([*names, order])
    return table.to_table(columns=list(columns), filter=is_its).sort_by(order)


def _array(name: str, cells: Any, column: Column, kind: str, length: int) -> np.ndarray:
    base.require(len(cells) == length, f"{length} rows of {name}", len(cells))
    base.require(cells.null_count == 0, f"no empty cells in {name}", cells.null_count)
    if kind == "image":
        base.require_fits(name, (length, *column.shape), np.uint8)
        return np.stack([_picture(cell, column.shape) for cell in cells.to_pylist()])
    flat = cells.combine_chunks()
    while pa.types.is_nested(flat.type):
        flat = flat.flatten()
    base.require(flat.null_count == 0, f"no empty cells in {name}", flat.null_count)
    array = flat.to_numpy(zero_copy_only=False).reshape(length, *column.shape)
    return array.astype(column.dtype, casting="same_kind", copy=False)


def _picture(cell: dict[str, Any], shape: tuple[int, ...]) -> np.ndarray:
    base.require(bool(cell.get("bytes")), "an image in the file", cell.get("path"))
    with Image.open(io.BytesIO(cell["bytes"]), formats=("PNG", "JPEG")) as image:
        base.require((image.height, image.width) == shape[:2], f"{list(shape)}", image.size)
        return np.asarray(image.convert("RGB"))


def _task(path: Path) -> str:
    """Returns the task's description; empty if there is not exactly one."""
    modern, old = path / "meta/tasks.parquet", path / "meta/tasks.jsonl"
    tasks = []
    if modern.exists():
        table = parquet.read_table(modern)
        texts = [name for name in table.column_names if pa.types.is_string(table[name].type)]
        tasks = table[texts[0]].to_pylist() if texts else []
    elif old.exists():
        tasks = [row["task"] for row in _json_lines(old)]
    return str(tasks[0]) if len(tasks) == 1 else ""


def _json_lines(path: Path) -> list[Any]:
    return [json.loads(line) for line in path.read_text().split("\n") if line.strip()]


def _recognises(path: Path) -> bool:
    return (path / "meta/info.json").is_file()


FORMAT = base.Format("LeRobotDataset v3.0", named, _recognises, _open, lerobot_write.write)
