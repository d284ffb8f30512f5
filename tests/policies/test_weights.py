"""Packaged weights are found by name, other files by path."""

from pathlib import Path

import pytest

from starjax import config
from starjax.policies import weights


@pytest.fixture
def packaged(tmp_path, monkeypatch):
    """A package with one file of weights."""
    (tmp_path / "compact.safetensors").touch()
    monkeypatch.setattr(weights, "_folder", lambda: tmp_path)
    return tmp_path / "compact.safetensors"


def test_a_name_is_a_file_of_the_package(packaged):
    assert weights.names() == ["compact"]
    assert weights.resolve("compact") == weights.find("--policy", "compact") == packaged
    assert weights.resolve("runs/x/policy.safetensors") == Path("runs/x/policy.safetensors")


def test_a_missing_file_is_one_line_that_lists_the_names(packaged):
    with pytest.raises(config.UsageError, match=r"--policy: expected compact or a file, got comp$"):
        weights.find("--policy", "comp")


def test_every_packaged_name_has_its_file():
    assert all(weights.find("--policy", name).is_file() for name in weights.names())
