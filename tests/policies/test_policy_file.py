"""policy.safetensors: a round trip, the same bytes every time, and damage noticed."""

import dataclasses
import json
import re

import fakes
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import safetensors
import safetensors.numpy

from starjax.data import normalizer
from starjax.policies import packaged, policy_file
from starjax.policies.monitor import record, scores
from starjax.sim import names

POLICY = dataclasses.replace(fakes.TINY, crop_fraction=0.8)
SCENE = names.SceneNames("hand_over", ("fr5", "panda"), ("grasper", "scope"), ("wrist", "camera"))


def trained(scale=1.0):
    params = {
        "learner": {"unet": {"kernel": scale * jnp.arange(6.0).reshape(2, 3)}},
        "vision": {"bias": jnp.ones(2)},
        "roll": {"bias": jnp.ones(3)},
    }
    box = normalizer.MinMax(-jnp.ones(5), jnp.arange(5.0))
    return fakes.trained(
        policy=POLICY,
        params=params,
        normalizer=normalizer.Normalizer(box, None),
        scene=SCENE,
        p_world_ref=((0.0, 0.0, 0.15), (0.0, 0.1, 0.15)),
        roll_zero=(0.0, 3.14),
    )


def with_monitor(policy, digest=None):
    monitor = record.Monitor(
        center=np.array([1e-3, -2e-3, 6.7, np.nan]),
        width=np.array([0.1, 0.2, 1.0, np.nan]) / 3,
        threshold=1.25,
        clock_s=7.9,
        alpha=0.05,
        count=1000,
        settings=scores.ScoreSettings(8, 30.0, 6),
        digest=digest or policy_file.monitor_digest(policy.params),
    )
    return policy._replace(monitor=monitor)


@pytest.mark.parametrize("half", [False, True])
def test_a_monitor_stays_with_its_weights_also_in_half_precision(tmp_path, half):
    path, made = tmp_path / "policy.safetensors", with_monitor(trained(scale=1 / 3))
    policy_file.save(path, made, half=half)
    found = policy_file.load(path)
    assert record.to_json(found.monitor) == record.to_json(made.monitor)
    assert policy_file.is_half(found.params) == half
    policy_file.save(path, found._replace(monitor=None), half=half)
    assert policy_file.load(path).monitor is None


def test_a_monitor_of_other_weights_is_refused(tmp_path):
    path = tmp_path / "policy.safetensors"
    other = policy_file.monitor_digest(trained(2.0).params)
    with pytest.raises(ValueError, match="monitor"):
        policy_file.save(path, with_monitor(trained(), other))
    assert not path.exists()
    policy_file.save(path, with_monitor(trained()))
    data = safetensors.numpy.load_file(path)
    about = about_of(path)
    data["params/roll/bias"] = data["params/roll/bias"] + 1
    envelope = {"about": about, "sha256": policy_file._hash(about, data)}
    safetensors.numpy.save_file(data, path, {"starjax": json.dumps(envelope)})
    with pytest.raises(ValueError, match="monitor"):
        policy_file.load(path)


def test_a_file_beside_the_weights_has_a_newer_monitor(tmp_path):
    path, made = tmp_path / "policy.safetensors", with_monitor(trained())
    policy_file.save(path, made)
    before, beside = path.read_bytes(), policy_file.monitor_path(path)
    newer = record.to_json(made.monitor) | {"threshold": 0.5}
    beside.write_text(json.dumps(newer))
    assert record.to_json(policy_file.load(path).monitor) == newer
    assert path.read_bytes() == before
    other = {"digest": policy_file.monitor_digest(trained(2.0).params)}
    decisions = {"settings": newer["settings"] | {"execute": 4}}
    for change in (other, {"scores": ["temper"]}, decisions, {"alpha": []}):
        beside.write_text(json.dumps(newer | change))
        refused(path, beside)
    for content in ("{", "[]"):
        beside.write_text(content)
        refused(path, beside)


def refused(path, named):
    """Expects that a policy is not read, in one line that begins with the file at fault."""
    with pytest.raises(ValueError, match=rf"^{re.escape(str(named))}[^\n]*$"):
        policy_file.load(path)


def about_of(path):
    with safetensors.safe_open(path, framework="numpy") as file:
        return json.loads(file.metadata()["starjax"])["about"]


def test_a_file_without_a_monitor_does_not_mention_it(tmp_path):
    path = tmp_path / "policy.safetensors"
    policy_file.save(path, trained())
    assert "monitor" not in about_of(path)
    assert not [name for name in safetensors.numpy.load_file(path) if "monitor" in name]


def test_round_trip(tmp_path):
    path = tmp_path / "policy.safetensors"
    policy_file.save(path, trained())
    found = policy_file.load(path)
    assert found.method == "stardiff"
    assert found._replace(params=None, normalizer=None) == trained()._replace(
        params=None, normalizer=None
    )
    assert found.normalizer.state is None
    jax.tree.map(np.testing.assert_array_equal, found.params, trained().params)
    jax.tree.map(np.testing.assert_array_equal, found.normalizer, trained().normalizer)


def test_the_turn_of_older_files_is_left_out(tmp_path):
    before = trained()._replace(method="stardiff_pose")
    old = before._replace(params={**before.params, "turn": {"b": 1.0}})
    policy_file.save(tmp_path / "p", with_monitor(old))
    after = policy_file.load(tmp_path / "p")
    assert policy_file.fingerprint(after.params) == policy_file.fingerprint(before.params)
    assert after.monitor.digest == policy_file.monitor_digest(before.params)
    policy_file.save(tmp_path / "again", after)  # refuses a monitor of other weights
    policy_file.save(tmp_path / "other", old._replace(method="theirs"))  # a network of that name
    assert "turn" in policy_file.load(tmp_path / "other").params


def test_the_packaged_policy_is_whole():
    found = policy_file.load(packaged.find("policy", "compact"))
    assert (found.scene, found.policy.crop_fraction) == (fakes.SCENE, 0.9)
    np.testing.assert_allclose(found.p_world_ref, [[0.0, 0.0, 0.15]], atol=1e-6)
    weights = "a136113a2624f1c184c0f15e3d4df31d000876997d05ed6cc183cfe8572d96ff"
    assert policy_file.fingerprint(found.params) == weights  # those of the training, halved


def test_same_policy_same_bytes(tmp_path):
    for name in "ab":
        policy_file.save(tmp_path / name, trained())
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_state_statistics_travel(tmp_path):
    box = normalizer.MinMax(-jnp.ones(12), jnp.ones(12))
    policy_file.save(tmp_path / "p", trained()._replace(normalizer=normalizer.Normalizer(box, box)))
    assert policy_file.load(tmp_path / "p").normalizer.state.high.shape == (12,)


def test_how_far_samples_reach_travels(tmp_path):
    box = normalizer.MinMax(-jnp.ones(5), jnp.ones(5), jnp.array([[-1.0] * 5, [1.5] * 5]))
    policy_file.save(
        tmp_path / "p", trained()._replace(normalizer=normalizer.Normalizer(box, None))
    )
    found = policy_file.load(tmp_path / "p").normalizer.action
    np.testing.assert_array_equal(found.reach, box.reach)


def test_non_finite_weights_are_not_saved(tmp_path):
    with pytest.raises(ValueError, match=r"expected finite values, got others in .*kernel"):
        policy_file.save(tmp_path / "p", trained(scale=np.nan))
    assert not (tmp_path / "p").exists()


def random(largest=4.0, size=(100, 300)):
    """A policy with weights of many magnitudes, some too small for float16."""
    rng = np.random.default_rng(1)
    kernel = rng.choice([-1, 1], size) * np.exp(rng.uniform(np.log(1e-9), np.log(largest), size))
    unet = {"kernel": jnp.asarray(kernel, jnp.float32), "count": jnp.arange(3)}
    return trained()._replace(params={"learner": {"unet": unet}})


def test_a_setting_of_a_newer_version_is_named_with_its_file(tmp_path, monkeypatch):
    as_json = policy_file.config_json.as_json
    monkeypatch.setattr(policy_file.config_json, "as_json", lambda x: {**as_json(x), "future": 1})
    policy_file.save(tmp_path / "p", trained())
    with pytest.raises(ValueError, match=r"p: made by another version of starjax: .*'future'"):
        policy_file.load(tmp_path / "p")


def test_half_precision_is_half_the_size_and_rounds(tmp_path):
    one = random()
    policy_file.save(tmp_path / "full", one)
    policy_file.save(tmp_path / "half", one, half=True)
    full, half = ((tmp_path / name).stat().st_size for name in ("full", "half"))
    assert 0.5 < half / full < 0.51
    found, before = (
        policy_file.load(tmp_path / "half"),
        np.asarray(one.params["learner"]["unet"]["kernel"]),
    )
    after = np.asarray(found.params["learner"]["unet"]["kernel"])
    assert after.dtype == np.float32
    error = np.abs(after - before)
    assert (error <= np.maximum(np.abs(before) / 2048, 3e-8)).all() and error.max() > 1e-4
    np.testing.assert_array_equal(found.params["learner"]["unet"]["count"], np.arange(3))
    assert (
        found.params["learner"]["unet"]["count"].dtype
        == one.params["learner"]["unet"]["count"].dtype
    )
    assert found._replace(params=None, normalizer=None) == one._replace(
        params=None, normalizer=None
    )


def test_half_precision_leaves_the_statistics_alone(tmp_path):
    box = normalizer.MinMax(jnp.full(5, -1.0001), jnp.full(5, 70_000.25))
    policy_file.save(
        tmp_path / "p", random()._replace(normalizer=normalizer.Normalizer(box, None)), True
    )
    found = policy_file.load(tmp_path / "p").normalizer.action
    jax.tree.map(np.testing.assert_array_equal, found, box)


def test_a_rounded_policy_stays_the_same(tmp_path):
    policy_file.save(tmp_path / "half", random(), half=True)
    rounded = policy_file.load(tmp_path / "half")
    policy_file.save(tmp_path / "full", rounded)
    policy_file.save(tmp_path / "again", rounded, half=True)
    assert policy_file.is_policy(tmp_path / "half") and policy_file.is_policy(tmp_path / "full")
    for name in ("full", "again"):
        found = policy_file.load(tmp_path / name)
        assert policy_file.fingerprint(found.params) == policy_file.fingerprint(rounded.params)
    assert (tmp_path / "again").read_bytes() == (tmp_path / "half").read_bytes()


def test_weights_too_large_for_half_precision_are_not_saved(tmp_path):
    policy_file.save(tmp_path / "full", trained(scale=20_000.0))
    with pytest.raises(ValueError, match=r"at most 65504 for float16, got 100000 in .*kernel"):
        policy_file.save(tmp_path / "half", trained(scale=20_000.0), half=True)
    assert not (tmp_path / "half").exists()


@pytest.mark.parametrize("half", [False, True])
def test_every_flipped_bit_is_noticed(tmp_path, half):
    path = tmp_path / "policy.safetensors"
    policy_file.save(path, trained(), half)
    content = path.read_bytes()
    rng = np.random.default_rng(0)
    for at in rng.integers(len(content), size=200):
        changed = bytearray(content)
        changed[at] ^= 1 << rng.integers(8)
        path.write_bytes(changed)
        try:
            found = policy_file.load(path)
        except ValueError as error:
            assert str(path) in str(error)
            continue
        # the rest is the padding of the header
        assert found.policy == POLICY and found.train == trained().train
        jax.tree.map(np.testing.assert_array_equal, found.params, trained().params)


@pytest.mark.parametrize("content", [b"", b"x" * 100, (1 << 60).to_bytes(8, "little") + b"{}"])
def test_other_files_are_refused(tmp_path, content):
    path = tmp_path / "policy.safetensors"
    path.write_bytes(content)
    with pytest.raises(ValueError, match="not a readable starjax policy"):
        policy_file.load(path)


@pytest.mark.parametrize(
    "lost", ["scene", "roll_zero", "method", "normalizer", "normalizer/action/low"]
)
def test_a_policy_of_another_version_is_named(tmp_path, lost):
    path = tmp_path / "policy.safetensors"
    policy_file.save(path, trained())
    with safetensors.safe_open(path, "numpy") as file:
        about = json.loads(file.metadata()["starjax"])["about"]
        arrays = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    about.pop(lost, None)
    arrays = {name: array for name, array in arrays.items() if not name.startswith(lost)}
    envelope = {"about": about, "sha256": policy_file._hash(about, arrays)}
    safetensors.numpy.save_file(arrays, path, {"starjax": json.dumps(envelope)})
    with pytest.raises(ValueError, match=r"policy\.safetensors: made by another version"):
        policy_file.load(path)


def test_a_file_that_may_not_be_read_is_not_called_damaged(tmp_path, monkeypatch):
    def refused(path, *_):
        raise PermissionError(13, "Permission denied", str(path))

    (tmp_path / "p").write_bytes(b"whatever")
    monkeypatch.setattr("builtins.open", refused)
    with pytest.raises(PermissionError):
        policy_file.load(tmp_path / "p")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"policy: expected a file, got .*nowhere"):
        policy_file.load(tmp_path / "nowhere")


def test_scalar_parameters_stay_scalars():
    flat = dict(policy_file._flatten({"sharp": np.zeros(()), "T": np.zeros((2, 3)).T}))
    assert flat["sharp"].shape == () and flat["T"].flags.c_contiguous


def test_deeply_nested_metadata_is_refused(tmp_path):
    path = tmp_path / "policy.safetensors"
    safetensors.numpy.save_file({"x": np.zeros(1)}, path, {"starjax": "[" * 100_000})
    with pytest.raises(ValueError, match="not a readable"):
        policy_file.load(path)
