"""Frames on disk: any order of them equals frames in memory."""

import os

import numpy as np
import pytest

from starjax.data import load


def test_frames_of_any_order_are_read_by_threads(tmp_path):
    """More than a thread's share, of float frames, twice and backwards."""
    lengths, rng = np.array([5, 3, 7]), np.random.default_rng(0)
    parts = [rng.normal(size=(n, 2, 3)).astype(np.float32) for n in lengths]
    paths = [tmp_path / f"{i}.npy" for i in range(3)]
    for path, part in zip(paths, parts):
        np.save(path, part)
    frames, whole = load.EpisodeArray(paths, np.array([0, 5, 8]), lengths), np.concatenate(parts)
    some = rng.integers(0, 15, (40, 4))
    np.testing.assert_array_equal(frames[some], whole[some])
    np.testing.assert_array_equal(frames[np.arange(15)[::-1]], whole[::-1])
    np.testing.assert_array_equal(frames[3], whole[3])
    os.truncate(paths[1], paths[1].stat().st_size - 8)
    with pytest.raises(OSError):
        frames[np.array([7])]


def test_headers_are_read_only_where_a_size_does_not_tell(tmp_path, monkeypatch):
    """Threads that read headers at once crash Python 3.11: a file is opened thousands of times."""
    parts = [np.full((n, 2), n, np.float32) for n in (3, 4, 5)]
    paths = [tmp_path / f"{len(part)}.npy" for part in parts]
    for path, part in zip(paths, parts):
        np.save(path, part)
    header = np.lib.format.magic(2, 0) + (20 + 54).to_bytes(4, "little")
    said = "{'descr': '<f4', 'fortran_order': False, 'shape': (4, 2), }"
    paths[1].write_bytes(header + said.ljust(73).encode() + b"\n" + parts[1].tobytes())
    frames = load.EpisodeArray(paths, np.array([0, 3, 7]), np.array([3, 4, 5]))
    loads, load_file = [], np.load
    monkeypatch.setattr(
        np, "load", lambda path, **given: loads.append(path) or load_file(path, **given)
    )
    np.testing.assert_array_equal(frames[np.arange(12)], np.concatenate(parts))
    assert set(loads) == {paths[1]}  # another length of header, met by two threads
