"""Checks of a format: a small dataset is written, recognised and read back."""

import tempfile
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from starjax.addons.formats import base, exchange
from starjax.addons.formats.base import FORMATS, Column, Format, Source
from starjax.core import errors
from starjax.testing.base import NOTE, Check, attempt, failed, verdict

LENGTHS = (5, 3, *(2,) * 9)  # control steps of episodes, whose names may be sorted as text
HZ = 30.0
SPLITS = {"train": range(9), "test": range(9, 11)}
SIDE = 48  # pixels
LOST = 8.0  # mean difference of a video from its smooth images
# Ends of file names that a format may be recognised by, the usual ones.
SUFFIXES = ("", ".hdf5", ".h5", ".zarr", ".zip", ".tar", ".csv", ".parquet", ".rrd", ".mcap")
COLUMNS = {
    "state": Column((8,), "float32", ("x", "y", "z", "qx", "qy", "qz", "qw", "gripper")),
    "action": Column((8,), "float32", ("x", "y", "z", "qx", "qy", "qz", "qw", "gripper")),
    "trocar": Column((3,), "float32", ("x", "y", "z")),
    "reward": Column((), "float32"),
    "done": Column((), "bool"),
    "image_camera": Column((SIDE, SIDE, 3), "uint8"),
    "starjax.qpos": Column((4,), "float32"),
}


def check(name: str, n: int) -> Iterator[Check]:
    """Yields the checks of a format; `n` is not used."""
    fault, form = attempt("record", lambda: FORMATS.get(name))
    if not fault:
        fault, source = attempt("named", lambda: _call(name, "named", lambda: _source(form)))
    yield fault or Check("record", form.description)
    if fault:
        return
    if form.write is None:
        yield Check("written", "read only", NOTE)
    with tempfile.TemporaryDirectory() as folder:
        for video in (False, True) if form.write else ():
            out = Path(folder) / ("video" if video else "exact")
            yield from _round_trip(name, form, source, out, video)
        empty = Path(folder) / "empty"
        empty.mkdir()
        taken = _call(name, "recognises", lambda: form.recognises(empty))
        yield verdict("recognises", ["an empty folder is of this format"] * bool(taken), "its own")


def _round_trip(name: str, form: Format, source: Source, out: Path, video: bool) -> Iterator[Check]:
    subject = f"written with video {'allowed' if video else 'off'}"
    fault, _ = attempt(
        subject,
        lambda: _call(name, "write", lambda: exchange.export(source, out, form, video)),
    )
    if not fault:
        ends = (end for end in SUFFIXES if _is_taken(form, out, end))
        out = out.with_suffix(next(ends, SUFFIXES[-1]))
        fault, detected = attempt(subject, lambda: base.detect(out))
    if fault:
        yield fault
    elif FORMATS.get(detected).recognises is not form.recognises:
        yield failed(subject, f"recognised as {detected}")
    else:
        fault, differences = attempt(subject, lambda: list(_differences(name, source, out, video)))
        yield fault or verdict(subject, differences, "read back with every number")


def _is_taken(form: Format, out: Path, suffix: str) -> bool:
    """Renames a dataset, whose name has no suffix or one of `SUFFIXES`; True if it is taken."""
    present = next(path for end in SUFFIXES if (path := out.with_suffix(end)).exists())
    return form.recognises(present.rename(out.with_suffix(suffix)))


def _differences(name: str, source: Source, out: Path, video: bool) -> Iterator[str]:
    with base.open_dataset(out, name) as found:
        for field in ("lengths", "hz", "origin", "task", "robot", "splits"):
            expected, got = getattr(source, field), getattr(found, field)
            if list(got) != list(expected) if field == "lengths" else got != expected:
                yield f"{field}: expected {expected}, got {got}"
        if list(found.lengths) != list(source.lengths):
            return
        missing = source.columns.keys() - found.columns.keys()
        if missing:
            yield f"columns: {', '.join(sorted(missing))} missing"
            return
        for column, about in source.columns.items():
            if about.names and found.columns[column].names != about.names:
                got = ", ".join(found.columns[column].names) or "none"
                yield f"names of {column}: expected {', '.join(about.names)}, got {got}"
        for episode in range(len(LENGTHS)):
            expected = source.read(episode, source.columns)
            got = found.read(episode, source.columns)
            for column, array in expected.items():
                alone = found.read(episode, [column])[column]
                if not np.array_equal(alone, got[column], equal_nan=alone.dtype.kind == "f"):
                    yield f"{column} of episode {episode} differs if it is read alone"
                if video and source.columns[column].is_image:
                    lost = float(np.abs(got[column].astype(float) - array).mean())
                    if lost > LOST:  # videos may lose a little
                        yield f"{column} of episode {episode} is off by {lost:.0f} of 255"
                    continue
                is_real = array.dtype.kind == "f"
                if not np.array_equal(got[column].reshape(array.shape), array, equal_nan=is_real):
                    yield f"{column} of episode {episode} differs"


def _source(form: Format) -> Source:
    """Returns a small dataset with the columns of an export."""
    columns = {form.named(name): column for name, column in COLUMNS.items()}
    if len(columns) != len(COLUMNS):
        raise errors.UsageError("named", f"{len(COLUMNS)} different names", ", ".join(columns))
    rng = np.random.default_rng(0)

    def draw(column: Column, length: int) -> np.ndarray:
        if column.is_image:
            ramp = np.linspace(0.0, 255.0, SIDE)
            image = np.stack(np.broadcast_arrays(ramp, ramp[:, None], 64.0), -1)
            return np.tile(image.astype(np.uint8), (length, 1, 1, 1))
        shape, high = (length, *column.shape), {"uint8": 256, "bool": 2}.get(column.dtype)
        drawn = rng.integers(0, high, shape) if high else rng.uniform(-1, 1, shape)
        return drawn.astype(column.dtype)

    def with_nan(arrays: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        arrays[form.named("state")][1, 2] = np.nan  # recordings have some
        return arrays

    arrays = [
        with_nan({name: draw(c, length) for name, c in columns.items()}) for length in LENGTHS
    ]

    def read(episode: int, names: Collection[str]) -> dict[str, np.ndarray]:
        return {name: arrays[episode][name] for name in names}

    origin = {"schema": 1, "digest": "none", "description": {"control_hz": HZ}}
    return Source(HZ, list(LENGTHS), columns, read, origin, "check", "none", splits=SPLITS)


def _call(name: str, function: str, call: Callable[[], Any]) -> Any:
    try:
        return call()
    except errors.UsageError:
        raise
    except Exception as error:
        got = f"{type(error).__name__}: {error}"
        raise errors.UsageError(f"format {name}: {function}", "a result", got) from error
