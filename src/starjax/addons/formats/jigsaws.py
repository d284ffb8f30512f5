"""JIGSAWS' kinematics: text, 76 numbers per line, 30 Hz, a file per episode.

Four times 19 numbers: both of the operator's handles, then both instruments, each

    position 3 m, rotation 9 by rows, velocity 3, angular velocity 3, gripper's angle rad

A folder of the release is read, that of a task (`Suturing`), or the one with the text files.
"""

import contextlib
from collections.abc import Collection, Iterator
from pathlib import Path

import numpy as np

from starjax.addons.formats import base, per_file
from starjax.addons.formats.base import Source

_HZ = 30.0
_FOLDER = "kinematics/AllGestures"
_ARMS = ("master_left", "master_right", "slave_left", "slave_right")
_COUNT = 19  # numbers of an arm


@contextlib.contextmanager
def _open(path: Path) -> Iterator[Source]:
    yield per_file.source(per_file.files(_folder(path), "*.txt"), _read, _HZ)


def _folder(path: Path) -> Path:
    inside = path / _FOLDER
    return inside if inside.is_dir() else path


def _read(path: Path, names: Collection[str]) -> dict[str, np.ndarray]:
    base.require_fits(path.name, (path.stat().st_size,), np.uint8)
    rows = np.loadtxt(path, ndmin=2)
    base.require(rows.shape[1] == len(_ARMS) * _COUNT, "76 numbers per line", rows.shape[1])
    return {name: rows[:, i * _COUNT : (i + 1) * _COUNT] for i, name in enumerate(_ARMS)}


def _recognises(path: Path) -> bool:
    folder = _folder(path)
    files = per_file.listed(folder, "*.txt") if folder.is_dir() else [folder]
    if not files or files[0].suffix != ".txt":
        return False
    with open(files[0], errors="replace") as file:
        return len(file.readline(4096).split()) == len(_ARMS) * _COUNT


FORMAT = base.Format("JIGSAWS' text files", per_file.same_name, _recognises, _open)
