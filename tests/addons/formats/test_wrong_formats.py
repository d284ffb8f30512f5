"""Formats that are wrong on purpose: the check of the part finds each."""

import contextlib

import numpy as np
import pytest

from starjax.addons.formats import base as formats
from starjax.addons.formats import part_check
from starjax.testing.base import FAILED

LOST = {"task": "", "robot": "", "splits": {}}
ORDERS = {"episodes": lambda i: -i, "sorted as text": str}


def format_of(fault, tmp_path):
    zarr = formats.FORMATS.get("zarr")

    def write(path, source, video):
        order = sorted(range(len(source.lengths)), key=ORDERS.get(fault, int))

        def read(episode, names):
            arrays = source.read(order[episode], names)
            if fault == "nan":
                arrays = {n: np.nan_to_num(x) for n, x in arrays.items()}
            if fault == "blank video" and video:
                arrays = {n: 0 * x if columns[n].is_image else x for n, x in arrays.items()}
            if fault == "integers":
                arrays = {n: np.round(x).astype(x.dtype) for n, x in arrays.items()}
            return arrays

        columns = dict(source.columns)
        if fault == "names":
            columns = {n: c._replace(names=()) for n, c in columns.items()}
        if fault == "order":
            columns = {n: c._replace(names=c.names[::-1]) for n, c in columns.items()}
        lengths = [source.lengths[i] for i in order]
        origin = None if fault == "origin" else source.origin
        changed = source._replace(read=read, columns=columns, lengths=lengths, origin=origin)
        if fault in LOST:
            changed = changed._replace(**{fault: LOST[fault]})
        zarr.write(path, changed, video)
        path.joinpath("of_mine").touch()

    @contextlib.contextmanager
    def opened(path):
        with zarr.open(path) as source:

            def read(episode, names):
                arrays = source.read(episode, names)
                return arrays if len(names) > 1 else {n: 0 * x for n, x in arrays.items()}

            yield source._replace(read=read) if fault == "read alone" else source

    own = lambda path: (path / "of_mine").exists()  # noqa: E731
    if fault == "any folder":
        own = lambda path: True  # noqa: E731
    return zarr._replace(write=write, open=opened, recognises=own)


FAULTS = [
    *("", "names", "order", "nan", "integers", *ORDERS, "origin", "any folder"),
    *("blank video", "read alone"),
    *LOST,
]


@pytest.mark.parametrize("fault", FAULTS)
def test_formats(monkeypatch, tmp_path, fault):
    mine = format_of(fault, tmp_path)
    # In front of the format that it writes by, which takes the same folder.
    rows = {"mine": mine, **formats.FORMATS.built_in}
    monkeypatch.setattr(part_check, "FORMATS", formats.FORMATS._replace(built_in=rows))
    monkeypatch.setattr(formats, "FORMATS", formats.FORMATS._replace(built_in=rows))
    failed = [check for check in part_check.check("mine", 1) if check.status == FAILED]
    assert bool(failed) == bool(fault)
    assert fault not in LOST or all(f"{fault}: expected" in check.text for check in failed)


@pytest.mark.parametrize("name", ["robomimic", "zarr"])
def test_own_formats(name):
    assert not [check for check in part_check.check(name, 1) if check.status == FAILED]
