"""Checkpoints: exact, kept to a number, and never restored damaged."""

import errno
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax.runtime import files
from starjax.training import checkpoint


def state(step):
    return {
        "step": jnp.int32(step),
        "w": jax.random.normal(jax.random.key(step), (64, 8)),
        "half": jnp.full(5, step, jnp.bfloat16),
        "key": jax.random.key(step),
        "none": None,
    }


def same(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            x, y = jax.random.key_data(x), jax.random.key_data(y)
        assert x.dtype == y.dtype
        np.testing.assert_array_equal(np.asarray(x), np.asarray(y))


@pytest.fixture
def three(tmp_path):
    for step in (10, 20, 30):
        checkpoint.save(tmp_path, step, state(step), keep=2)
    return tmp_path


def test_newest_comes_back_exactly_and_old_ones_go(three):
    assert checkpoint.steps(three) == [20, 30]
    step, restored = checkpoint.restore(three, state(0))
    assert step == 30
    same(restored, state(30))
    assert sorted(path.name for path in three.iterdir()) == ["step_00000020", "step_00000030"]


def test_nothing_there(tmp_path):
    assert checkpoint.restore(tmp_path / "none", state(0)) is None
    assert checkpoint.steps(tmp_path / "none") == []


def files_of(directory, step):
    root = checkpoint.path_of(directory, step)
    return [file for file in sorted(root.rglob("*")) if file.is_file() and file.stat().st_size]


def damage_of_every_file(directory, step, change, seen):
    """Changes each file of a step in turn; `seen` gets the file and the restored step."""
    for file in files_of(directory, step):
        content = file.read_bytes()
        change(file, content)
        seen(file)
        file.write_bytes(content)


def test_flipped_bit_anywhere_is_named_and_the_step_before_is_used(three):
    rng = np.random.default_rng(0)

    def flip(file, content):
        changed = bytearray(content)
        changed[rng.integers(len(changed))] ^= 1 << rng.integers(8)
        file.write_bytes(changed)

    def seen(file):
        # a flip inside the manifest may say that another file is at fault, but never passes
        named = "manifest" if file.name == "manifest.json" else file.name
        with pytest.warns(UserWarning, match=f"step 30 is damaged: .*{named}"):
            step, restored = checkpoint.restore(three, state(0))
        assert step == 20
        same(restored, state(20))

    damage_of_every_file(three, 30, flip, seen)
    assert checkpoint.restore(three, state(0))[0] == 30


def test_truncated_or_missing_file_is_named(three):
    def seen(file):
        with pytest.raises(checkpoint.DamagedCheckpoint, match=file.name):
            checkpoint.verify(checkpoint.path_of(three, 30))

    damage_of_every_file(three, 30, lambda f, c: f.write_bytes(c[:-1]), seen)
    damage_of_every_file(three, 30, lambda f, c: f.unlink(), seen)


def test_a_file_that_the_disk_does_not_give_back_costs_its_step(three, monkeypatch):
    lost, sha256 = files_of(three, 30)[-1], checkpoint.files.sha256

    def read(file):
        if file == lost:
            raise OSError(errno.EIO, "Input/output error")
        return sha256(file)

    monkeypatch.setattr(checkpoint.files, "sha256", read)
    with pytest.warns(UserWarning, match=f"step 30 is damaged: .*{lost.name} cannot be read"):
        assert checkpoint.restore(three, state(0))[0] == 20


def test_all_damaged_is_a_fresh_start(three):
    for step in (20, 30):
        files_of(three, step)[-1].write_bytes(b"x")
    with pytest.warns(UserWarning, match="damaged"):
        assert checkpoint.restore(three, state(0)) is None


@pytest.mark.parametrize("keep", [1, 2])
def test_damaged_steps_never_push_out_a_sound_one(three, keep):
    for step in (20, 30):
        files_of(three, step)[-1].write_bytes(b"x")
    for step in (5, 20):
        checkpoint.save(three, step, state(step), keep=keep)
        assert checkpoint.restore(three, state(0))[0] == step
    assert checkpoint.steps(three) == [5, 20][-keep:]


def test_leftovers_of_a_kill_are_cleared(three):
    (three / ".writing-40").mkdir()
    (three / ".writing-40" / "half").write_bytes(b"x")
    assert checkpoint.restore(three, state(0))[0] == 30
    checkpoint.save(three, 40, state(40), keep=2)
    assert checkpoint.steps(three) == [30, 40]
    assert not list(three.glob(".writing*"))


@pytest.mark.parametrize(
    "other", [{"w": jnp.zeros((64, 9))}, {"half": jnp.zeros(5)}, {"more": jnp.zeros(1)}]
)
def test_other_settings_are_an_error_and_not_a_cast(three, other):
    with pytest.raises(ValueError, match=f"other settings.*{next(iter(other))}"):
        checkpoint.restore(three, {**state(0), **other})


def test_full_disk_is_one_sentence(three, monkeypatch):
    def full(*_):
        raise ValueError("RESOURCE_EXHAUSTED: writing: No space left on device [OS error 28]")

    monkeypatch.setattr(checkpoint.ocp, "save", full)
    with pytest.raises(files.StorageError, match=r"no space left.*step 40.*from step 30"):
        checkpoint.save(three, 40, state(40), keep=2)
    # continued from 20, as 30 is damaged
    with pytest.raises(files.StorageError, match=r"no space left.*step 25.*from step 20"):
        checkpoint.save(three, 25, state(25), keep=2)
    assert checkpoint.steps(three) == [20, 30]
    assert not list(three.glob(".writing*"))


def test_too_little_space_is_found_before_writing(three, monkeypatch):
    usage = type("Usage", (), {"free": 10})
    monkeypatch.setattr(checkpoint.shutil, "disk_usage", lambda _: usage)
    with pytest.raises(files.StorageError, match="no space left"):
        checkpoint.save(three, 40, state(40), keep=2)


def test_other_failures_stay_what_they_are(three, monkeypatch):
    def fail(*_):
        raise OSError(errno.EIO, "input/output error")

    monkeypatch.setattr(checkpoint.ocp, "save", fail)
    with pytest.raises(OSError, match="input/output"):
        checkpoint.save(three, 40, state(40), keep=2)


def test_manifest_lists_every_file(three):
    root = checkpoint.path_of(three, 30)
    manifest = json.loads((root / "manifest.json").read_text())["manifest"]
    there = {f.relative_to(root).as_posix() for f in root.rglob("*") if f.is_file()}
    assert set(manifest["files"]) == there - {"manifest.json"}
