"""A format: a folder with one .npz per episode and a JSON file of the rest."""

import contextlib
import json

import numpy as np

from starjax.addons.formats.base import OURS, Column, Format, Source, origin_hz

ABOUT = "arrays.json"


@contextlib.contextmanager
def open_folder(path):
    """Yields the source of a folder."""
    about = json.loads((path / ABOUT).read_text())
    columns = {n: Column(tuple(shape), dtype) for n, (shape, dtype) in about["columns"].items()}

    def read(episode, names):
        with np.load(path / f"{episode}.npz", allow_pickle=False) as arrays:
            return {name: arrays[name] for name in names}

    yield Source(origin_hz(about[OURS]), about["lengths"], columns, read, about[OURS])


def write(path, source, video):
    """Writes a source as a folder."""
    path.mkdir()
    for episode in range(len(source.lengths)):
        np.savez(path / f"{episode}.npz", **source.read(episode, source.columns))
    columns = {name: [list(c.shape), c.dtype] for name, c in source.columns.items()}
    about = {"columns": columns, "lengths": list(source.lengths), OURS: source.origin}
    (path / ABOUT).write_text(json.dumps(about))


FORMAT = Format(
    description="a folder of npz files",
    named=lambda column: column,
    recognises=lambda path: (path / ABOUT).is_file(),
    open=open_folder,
    write=write,
)
