"""Files survive kills, faults are named, and one run holds a folder."""

import io
import os

import numpy as np
import pytest

from starjax.runtime import files


def test_a_failed_write_leaves_the_old_content(tmp_path, monkeypatch):
    path = tmp_path / "a.json"
    files.write_json(path, {"x": 1})

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(files.StorageError, match=r"cannot write .*a\.json.*No space left"):
        files.write_json(path, {"x": 2})
    assert path.read_text() == '{\n "x": 1\n}\n'
    assert os.listdir(tmp_path) == ["a.json"]


def test_a_directory_appears_whole_or_not_at_all(tmp_path, monkeypatch):
    final, staged = tmp_path / "final", tmp_path / "staged"
    contents = {"one": [b"1"], "two": [b"2", b"2"]}
    with monkeypatch.context() as patch:
        patch.setattr(os, "rename", lambda *_: (_ for _ in ()).throw(OSError(13, "denied")))
        with pytest.raises(files.StorageError, match="denied"):
            files.commit_directory(final, staged, contents)
    assert not final.exists()
    files.commit_directory(final, staged, contents)
    assert {p.name: p.read_bytes() for p in final.iterdir()} == {"one": b"1", "two": b"22"}


def test_npz_bytes_are_a_function_of_the_arrays(tmp_path, monkeypatch):
    arrays = {"a": np.arange(10.0), "b": np.zeros((3, 2), np.uint8)}
    files.write_npz(tmp_path / "1.npz", arrays)
    monkeypatch.setattr("time.time", lambda: 2e9)
    files.write_npz(tmp_path / "2.npz", arrays)
    assert files.sha256(tmp_path / "1.npz") == files.sha256(tmp_path / "2.npz")
    with np.load(tmp_path / "1.npz", allow_pickle=False) as loaded:
        np.testing.assert_array_equal(loaded["a"], arrays["a"])


@pytest.mark.parametrize("dtype", ["uint8", "float32", "bool"])
def test_parts_are_saved_as_numpy_saves_the_whole(dtype):
    whole = np.arange(5 * 2 * 3).reshape(5, 2, 3).astype(dtype)
    expected = io.BytesIO()
    np.save(expected, whole, allow_pickle=False)
    for parts in ([whole], [whole[:3], whole[3:], whole[:0]], [np.asfortranarray(whole)]):
        assert b"".join(files.npy(parts)) == expected.getvalue()


def test_objects_and_nan_are_refused(tmp_path):
    with pytest.raises(ValueError):
        files.npy([np.array([object()])])
    with pytest.raises(ValueError, match=r"one type and shape, got float32\[\], float64\[\]"):
        files.npy([np.zeros(2), np.zeros(2, np.float32)])
    with pytest.raises(ValueError):
        files.write_json(tmp_path / "x.json", float("nan"))


@pytest.mark.parametrize("text", ["[" * 100_000, "{", "[1"])
def test_a_file_that_is_no_json_is_named(tmp_path, text):
    (tmp_path / "x.json").write_text(text)
    with pytest.raises(ValueError, match=r"x\.json"):
        files.read_json(tmp_path / "x.json")


def test_space_is_checked_before_it_is_needed(tmp_path):
    with pytest.raises(files.StorageError, match="the disk has"):
        files.require_writable(tmp_path, free_bytes=1 << 60)


def test_a_folder_that_cannot_be_made_is_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(files.StorageError) as caught:
        files.require_writable(tmp_path / "file" / "sub")
    assert "\n" not in str(caught.value) and "sub" in str(caught.value)


def test_a_full_disk_keeps_no_probe(tmp_path, monkeypatch):
    def full(path, data):
        path.touch()
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files.Path, "write_bytes", full)
    with pytest.raises(files.StorageError, match="No space left"):
        files.require_writable(tmp_path)
    assert not os.listdir(tmp_path)
