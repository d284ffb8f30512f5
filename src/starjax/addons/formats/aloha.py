"""ALOHA's HDF5: a file `episode_<i>.hdf5` per episode.

    action [T, n], observations/qpos, observations/qvel
    observations/images/<camera>   [T, h, w, 3] uint8, or a JPEG per step, padded with zeros

Rates are not in the files; the peer's are of 50 Hz.
"""

import contextlib
import io
import re
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from starjax.addons.formats import base, per_file, robomimic
from starjax.addons.formats.base import Column, Source

if TYPE_CHECKING:  # for annotations alone
    import h5py

_FILE = re.compile(r"episode_\d+\.(hdf5|h5)")
_IMAGES = "observations/images/"


@contextlib.contextmanager
def _open(path: Path) -> Iterator[Source]:
    yield per_file.source(per_file.files(path, "episode_*.h*5"), _read, hz=0.0, look=_look)


def _look(path: Path) -> tuple[int, dict[str, Column]]:
    with robomimic.opened(path) as data:
        length = robomimic.episode_length(data)
        return length, _columns(data, length)


def _read(path: Path, names: Collection[str]) -> dict[str, np.ndarray]:
    with robomimic.opened(path) as data:
        return {name: _array(data, name) for name in names if name in data}


def _columns(data: "h5py.Group", length: int) -> dict[str, Column]:
    columns = {}
    for name, dataset in robomimic.datasets(data).items():
        if dataset.shape[:1] != (length,):
            continue
        if _is_packed(name, dataset):
            columns[name] = Column(_picture(dataset[0]).shape, "uint8")
        elif dataset.dtype.kind in "biuf":
            columns[name] = Column(dataset.shape[1:], dataset.dtype.name)
    return columns


def _array(data: "h5py.Dataset", name: str) -> np.ndarray:
    dataset = data[name]
    base.require_fits(name, dataset.shape, dataset.dtype)
    rows = dataset[()]
    return np.stack([_picture(row) for row in rows]) if _is_packed(name, dataset) else rows


def _is_packed(name: str, dataset: "h5py.Dataset") -> bool:
    """Returns True for images as a JPEG or PNG per step."""
    is_bytes = dataset.dtype == np.uint8 and dataset.ndim == 2
    return name.startswith(_IMAGES) and (is_bytes or dataset.dtype.kind == "O")


def _picture(row: np.ndarray) -> np.ndarray:
    data = np.asarray(row, np.uint8).tobytes()
    with Image.open(io.BytesIO(data), formats=("PNG", "JPEG")) as image:
        base.require_fits("an image", (image.height, image.width, 3), np.uint8)
        return np.asarray(image.convert("RGB"))


def _recognises(path: Path) -> bool:
    files = path.iterdir() if path.is_dir() else [path]
    return any(_FILE.fullmatch(file.name) for file in files)


FORMAT = base.Format("HDF5 of ALOHA, a file per episode", per_file.same_name, _recognises, _open)
