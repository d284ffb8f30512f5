"""policy.safetensors: a round trip, the same bytes every time, and damage noticed."""

import fakes
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax import config
from starjax.data import normalizer
from starjax.training import export


def trained(scale=1.0):
    params = {
        "diffuser": {"unet": {"kernel": scale * jnp.arange(6.0).reshape(2, 3)}},
        "roll": {"bias": jnp.ones(3)},
    }
    box = normalizer.MinMax(-jnp.ones(5), jnp.arange(5.0))
    return export.Trained(
        "stardiff",
        fakes.TINY,
        config.TrainConfig(crop_fraction=0.8),
        params,
        normalizer.Normalizer(box, None),
        (0.0, 0.0, 0.15),
    )


def test_round_trip(tmp_path):
    path = tmp_path / "policy.safetensors"
    export.save(path, trained())
    found = export.load(path)
    assert found.method == "stardiff"
    assert found.policy == fakes.TINY and found.train.crop_fraction == 0.8
    assert found.p_world_ref == (0.0, 0.0, 0.15)
    assert found.normalizer.state is None
    jax.tree.map(np.testing.assert_array_equal, found.params, trained().params)
    jax.tree.map(np.testing.assert_array_equal, found.normalizer, trained().normalizer)


def test_same_policy_same_bytes(tmp_path):
    for name in "ab":
        export.save(tmp_path / name, trained())
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_state_statistics_travel(tmp_path):
    box = normalizer.MinMax(-jnp.ones(12), jnp.ones(12))
    export.save(tmp_path / "p", trained()._replace(normalizer=normalizer.Normalizer(box, box)))
    assert export.load(tmp_path / "p").normalizer.state.high.shape == (12,)


def test_non_finite_weights_are_not_saved(tmp_path):
    with pytest.raises(ValueError, match=r"expected finite values, got others in .*kernel"):
        export.save(tmp_path / "p", trained(scale=np.nan))
    assert not (tmp_path / "p").exists()


def test_every_flipped_bit_is_noticed(tmp_path):
    path = tmp_path / "policy.safetensors"
    export.save(path, trained())
    content = path.read_bytes()
    rng = np.random.default_rng(0)
    for at in rng.integers(len(content), size=200):
        changed = bytearray(content)
        changed[at] ^= 1 << rng.integers(8)
        path.write_bytes(changed)
        try:
            found = export.load(path)
        except ValueError as error:
            assert str(path) in str(error)
            continue
        # what is left is the padding of the header
        assert found.policy == fakes.TINY and found.train == trained().train
        jax.tree.map(np.testing.assert_array_equal, found.params, trained().params)


@pytest.mark.parametrize("content", [b"", b"x" * 100, (1 << 60).to_bytes(8, "little") + b"{}"])
def test_other_files_are_refused(tmp_path, content):
    path = tmp_path / "policy.safetensors"
    path.write_bytes(content)
    with pytest.raises(ValueError, match="not a readable starjax policy"):
        export.load(path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"policy: expected a file, got .*nowhere"):
        export.load(tmp_path / "nowhere")
