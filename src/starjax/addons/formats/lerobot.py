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
import math
import re
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
from PIL import Image

from starjax.addons.formats import base, lerobot_meta, lerobot_write, per_file, video
from starjax.addons.formats.base import Column, Source
from starjax.runtime import files
from starjax.sim.rollouts import episodes

if TYPE_CHECKING:  # for annotations alone
    from pyarrow import parquet as pq

_NAMES = {
    "state": "observation.state",
    "trocar": "observation.trocar",
    "environment_state": "observation.environment_state",
    "reward": "next.reward",
    "done": "next.done",
}
_FEATURE = re.compile(r"[\w.][\w.\- ]*")  # a feature's name, which is also a folder's
_NUMBERS = (
    *("bool", "float16", "float32", "float64", "int8", "int16", "int32", "int64"),
    *("uint8", "uint16", "uint32", "uint64"),
)
_RGB = ("RGB", "RGBA", "P", "L")  # modes that convert to 8-bit colours
_BATCH = 1 << 12  # rows that are read at once
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
    columns, kinds, notes, texts = {}, {}, [], []
    for name, feature in info["features"].items():
        base.require(bool(_FEATURE.fullmatch(name)) and ".." not in name, "a name", name)
        if (column := _column(feature)) is not None:
            columns[name], kinds[name] = column, feature["dtype"]
        elif feature["dtype"] == "string":
            texts.append(name)
        else:
            notes.append(f"{name}: {feature['dtype']} {feature['shape']} is not read; omitted")
    cameras = [name for name, kind in kinds.items() if kind == "video"]
    places = list(_READERS[version[:3]](path, info, cameras))
    notes += _shifted(places, hz)

    def read(episode: int, names: Collection[str]) -> dict[str, np.ndarray]:
        place = places[episode]
        numeric = [name for name in names if kinds[name] != "video"]
        table = _rows(path, place, {name: columns[name] for name in numeric})
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
    lengths = [place.length for place in places]
    tasks = lerobot_meta.tasks(path)
    task = next(iter(tasks.values())) if len(tasks) == 1 else ""

    def texts_of(episode: int) -> dict[str, list[str]]:
        wanted = {name: Column((), "str") for name in (*texts, "task_index")}
        table = _rows(path, places[episode], wanted)
        found = {name: table[name].unique().to_pylist() for name in texts}
        numbers = table["task_index"].unique().to_pylist()
        return found | {"task": [tasks[i] for i in numbers if i in tasks]}

    splits = lerobot_meta.splits(info, len(places))
    yield Source(hz, lengths, columns, read, origin, task, robot, notes, splits, texts_of)


def _shifted(places: list[_Place], hz: float) -> Iterator[str]:
    """Yields notes on videos in which an episode begins where the one before does not end."""
    files_of: dict[Path, list[tuple[float, int, int]]] = {}
    for place in places:
        for file, first in place.videos.values():
            files_of.setdefault(file, []).append((first, place.length, place.number))
    for file, rows in files_of.items():
        frame = 0
        for first, length, number in sorted(rows):
            if (at := round(first * hz)) != frame:
                where = "/".join(file.parts[-4:])
                yield f"{where}: episode {number} begins at frame {at}, where {frame} is expected"
                break
            frame = at + length


def _column(feature: dict[str, Any]) -> Column | None:
    """Converts a feature to a column; returns None for text, depth and other kinds."""
    kind, shape = feature["dtype"], tuple(int(n) for n in feature["shape"])
    if kind in ("image", "video"):
        base.require(len(shape) == 3, "[h, w, 3]", list(shape))
        first = shape[0] == 3 and shape[2] != 3
        column = Column((*shape[1:], 3) if first else shape, "uint8")
        return column if column.is_image else None
    if kind not in _NUMBERS:
        return None
    base.require(all(n > 0 for n in shape), "sizes above 0", list(shape))
    names = feature.get("names")
    names = next(iter(names.values())) if isinstance(names, dict) and names else names
    if isinstance(names, list) and len(names) == 1 and isinstance(names[0], list):
        names = names[0]  # as peers' converters write them
    named = tuple(map(str, names)) if isinstance(names, list) else ()
    return Column(() if shape == (1,) else shape, np.dtype(kind).name, named)


def _places_v3(root: Path, info: dict[str, Any], cameras: list[str]) -> Iterator[_Place]:
    paths = per_file.listed(root, "meta/episodes/*/*.parquet")
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
    for row in lerobot_meta.json_lines(root / "meta/episodes.jsonl"):
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
    base.require(0 <= int(value) < 10**8, "control steps", value)
    return int(value)


def _rows(root: Path, place: _Place, columns: dict[str, Column]) -> Any:
    """Reads the rows of an episode; statistics let parquet skip other row groups.

    A small file may unpack to gigabytes: reading ends after more rows than the episode has.
    """
    if not columns:
        return {}
    base.require(place.table.is_file(), "a file of numbers", f"none at {place.table}")
    file = parquet.ParquetFile(base.require_inside(root, place.table))
    order = "frame_index" if "frame_index" in file.schema_arrow.names else "episode_index"
    wanted = list(dict.fromkeys([*columns, order, "episode_index"]))
    groups = [
        i
        for i in range(file.num_row_groups)
        if _may_hold(file.metadata.row_group(i), columns, place.number)
    ]
    batches, count = [], 0
    for batch in file.iter_batches(_BATCH, groups, wanted):
        is_its = batch["episode_index"].to_numpy(zero_copy_only=False) == place.number
        rows = batch.filter(pa.array(is_its))
        batches.append(rows)
        count += rows.num_rows
        base.require(count <= place.length, f"{place.length} rows", "more")
    base.require(bool(batches), f"{place.length} rows", 0)
    return pa.Table.from_batches(batches).sort_by(order)


def _may_hold(group: "pq.RowGroupMetaData", columns: dict[str, Column], number: int) -> bool:
    """Returns False for a row group without rows of the episode, by its statistics.

    Raises:
      Damaged: lists in it are longer than their columns.
    """
    holds = True
    for i in range(group.num_columns):
        part = group.column(i)
        name, numbers = part.path_in_schema, part.statistics
        if name == "episode_index" and numbers is not None and numbers.has_min_max:
            holds = numbers.min <= number <= numbers.max
        name = name.removesuffix(".list.element").removesuffix(".list.item")
        if name in columns and not columns[name].is_image:
            most = group.num_rows * math.prod(columns[name].shape)
            base.require(part.num_values <= most, f"{most} numbers of {name}", part.num_values)
    return holds


def _array(name: str, cells: pa.ChunkedArray, column: Column, kind: str, length: int) -> np.ndarray:
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
        base.require(image.mode in _RGB, "8-bit colours", f"a picture of mode {image.mode}")
        return np.asarray(image.convert("RGB"))


def _recognises(path: Path) -> bool:
    return (path / "meta/info.json").is_file()


FORMAT = base.Format(
    "LeRobotDataset v3.0; v2.1 is read too", named, _recognises, _open, lerobot_write.write
)
