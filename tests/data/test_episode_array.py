"""Frames on disk: those of any order, as if they were in memory."""

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
