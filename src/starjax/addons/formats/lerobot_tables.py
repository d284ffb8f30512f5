"""Tables of a LeRobotDataset of any version: features, cells of parquet, statistics."""

import io
import json
from typing import Any

import numpy as np
import pyarrow as pa
from PIL import Image

from starjax.addons.formats import video
from starjax.addons.formats.base import Column, Source
from starjax.core import errors

CHUNK = 1000  # files a folder, as LeRobot has them
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


def whole_hz(source: Source) -> int:
    """Returns the control steps per second, of which LeRobot requires a whole number."""
    hz = round(source.hz)
    if hz != source.hz or hz < 1:
        raise errors.UsageError("DATASET", "a whole number of steps per second", source.hz)
    return hz


def table(features: dict[str, Any], arrays: dict[str, np.ndarray]) -> pa.Table:
    """Returns the numbers of an episode, with images that are not in videos as PNG."""
    names = [name for name, feature in features.items() if feature["dtype"] != "video"]
    rows = pa.table({name: _cells(arrays[name], features[name]) for name in names})
    described = {name: _described(features[name]) for name in names}
    text = json.dumps({"info": {"features": described}})
    return rows.replace_schema_metadata({"huggingface": text})


def splits(source: Source) -> dict[str, str]:
    """Returns the splits as info.json has them."""
    given = source.splits or {"train": range(len(source.lengths))}
    return {name: f"{span.start}:{span.stop}" for name, span in given.items()}


def features(source: Source, hz: int, with_video: bool) -> dict[str, Any]:
    """Returns the features of info.json: all columns, and those that count steps."""
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


def counted(episode: int, length: int, first: int, hz: int) -> dict[str, np.ndarray]:
    """Returns the columns that count steps and episodes."""
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


def sampled(images: np.ndarray) -> np.ndarray:
    """Returns the images and pixels whose statistics are taken."""
    chosen = np.linspace(0, len(images) - 1, min(len(images), _SAMPLES)).astype(int)
    return images[chosen][:, ::_EVERY, ::_EVERY]


def stats(array: np.ndarray) -> dict[str, list]:
    """Returns the statistics of a column, quantiles too."""
    is_image = array.ndim == 4 and array.dtype == np.uint8
    rows = array.reshape(-1, 3) / 255.0 if is_image else array.reshape(len(array), -1)
    rows = np.where(np.isfinite(rows), rows, 0.0)  # JSON has no other numbers
    figures = {"min": rows.min(0), "max": rows.max(0), "mean": rows.mean(0), "std": rows.std(0)}
    figures |= dict(zip(_QUANTILES, np.quantile(rows, list(_QUANTILES.values()), axis=0)))
    shape = (3, 1, 1) if is_image else (-1,)
    return {n: x.reshape(shape).tolist() for n, x in figures.items()} | {"count": [len(array)]}
