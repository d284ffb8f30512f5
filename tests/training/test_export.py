"""A policy's file: what is read is what was written, and damage is named."""

import jax
import numpy as np
import pytest

from starjax import config
from starjax.data import normalizer
from starjax.training import export


def trained(state: bool) -> export.Trained:
    rng = np.random.default_rng(0)
    scaling = normalizer.MinMax(rng.normal(size=5).astype("f4"), rng.normal(size=5).astype("f4"))
    params = {
        "unet": {"conv": {"kernel": rng.normal(size=(3, 2)).astype("f4")}, "scale": np.ones(())}
    }
    return export.Trained(
        weights_of="stardiff",
        policy=config.PolicyConfig(unet_channels=(8, 16)),
        train=config.TrainConfig(steps=7),
        params=params,
        normalizer=normalizer.Normalizer(action=scaling, state=scaling if state else None),
    )


@pytest.mark.parametrize("state", [False, True])
def test_round_trip(tmp_path, state):
    before = trained(state)
    export.save(tmp_path / "policy.safetensors", before)
    after = export.load(tmp_path / "policy.safetensors")
    assert jax.tree.structure(after[3:]) == jax.tree.structure(before[3:])
    jax.tree.map(np.testing.assert_array_equal, after[3:], before[3:])
    assert after[:3] == before[:3]


def test_the_same_policy_gives_the_same_bytes(tmp_path):
    for name in ("a", "b"):
        export.save(tmp_path / name, trained(True))
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


@pytest.mark.parametrize("content", [b"", b"garbage" * 20])
def test_damage_is_named(tmp_path, content):
    path = tmp_path / "policy.safetensors"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"policy\.safetensors"):
        export.load(path)


def test_a_file_cut_short_is_named(tmp_path):
    path = tmp_path / "policy.safetensors"
    export.save(path, trained(True))
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(ValueError, match=r"policy\.safetensors"):
        export.load(path)
