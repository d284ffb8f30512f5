"""Formats that are wrong on purpose: the check of the part finds each."""

import numpy as np
import pytest

from starjax.addons.formats import base as formats
from starjax.addons.formats import part_check
from starjax.testing.base import FAILED


def format_of(fault, tmp_path):
    zarr = formats.FORMATS.get("zarr")

    def write(path, source, video):
        def read(episode, names):
            arrays = source.read(1 - episode if fault == "episodes" else episode, names)
            if fault == "nan":
                arrays = {n: np.nan_to_num(x) for n, x in arrays.items()}
            if fault == "integers":
                arrays = {n: np.round(x).astype(x.dtype) for n, x in arrays.items()}
            return arrays

        columns = dict(source.columns)
        if fault == "names":
            columns = {n: c._replace(names=()) for n, c in columns.items()}
        if fault == "order":
            columns = {n: c._replace(names=c.names[::-1]) for n, c in columns.items()}
        lengths = source.lengths[::-1] if fault == "episodes" else source.lengths
        origin = None if fault == "origin" else source.origin
        changed = source._replace(read=read, columns=columns, lengths=lengths, origin=origin)
        zarr.write(path, changed, video)
        path.joinpath("of_mine").touch()

    own = lambda path: (path / "of_mine").exists()  # noqa: E731
    if fault == "any folder":
        own = lambda path: True  # noqa: E731
    return zarr._replace(write=write, recognises=own)


@pytest.mark.parametrize(
    "fault", ["", "names", "order", "nan", "integers", "episodes", "origin", "any folder"]
)
def test_formats(monkeypatch, tmp_path, fault):
    mine = format_of(fault, tmp_path)
    # In front of the format that it writes by, which takes the same folder.
    rows = {"mine": mine, **formats.FORMATS.built_in}
    monkeypatch.setattr(part_check, "FORMATS", formats.FORMATS._replace(built_in=rows))
    monkeypatch.setattr(formats, "FORMATS", formats.FORMATS._replace(built_in=rows))
    failed = [check for check in part_check.check("mine", 1) if check.status == FAILED]
    assert bool(failed) == bool(fault)
