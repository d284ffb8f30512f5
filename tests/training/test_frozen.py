"""A frozen encoder: training and inference share its inputs, and its weights stay."""

import dataclasses
import functools
import threading
import time

import fakes
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stubs

from starjax.cli import demonstrations, folders, pipeline, presets
from starjax.core import config
from starjax.core.methods import METHODS
from starjax.data import load, normalizer, redraw, windows
from starjax.policies import generator, policy_file
from starjax.policies import policy as policies
from starjax.sim.rollouts import sharing
from starjax.training import checkpoint, encoder, frozen, log, loop, state

pytestmark = pytest.mark.slow

TRAIN = config.TrainConfig(
    steps=6,
    batch_size=16,
    learning_rate=1e-2,
    warmup_steps=1,
    steps_per_call=1,
    checkpoint_every=4,
    log_every=3,
    holdout_demos=1,
)
IMAGE = dataclasses.replace(fakes.TINY, observation="image")
QUICK = {"xla_backend_optimization_level": 0}  # these programs run once


@pytest.fixture(scope="module")
def dataset():
    return fakes.dataset(seed=0, demos=4, length=20, image_size=IMAGE.image_size)


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """Settings of a frozen policy, whose encoder another policy has; and that encoder."""
    path = tmp_path_factory.mktemp("source") / "policy.safetensors"
    vision, size = generator.vision_encoder(IMAGE), IMAGE.image_size
    init = jax.jit(vision.init, compiler_options=QUICK)
    params = {"vision": init(jax.random.key(5), jnp.zeros((1, size, size, 3)))}
    policy_file.save(path, fakes.trained(method="dp_rcm2", policy=IMAGE, params=params))
    settings = dataclasses.replace(IMAGE, encoder_weights=str(path), freeze_encoder=True)
    return settings, encoder.read(settings)


def features(source, dataset, root, digest="demos", camera="camera", frames=None, said=None):
    settings, found = source
    pictures = np.asarray(dataset.observation.images["camera"])
    return frozen.features(
        found,
        settings,
        root,
        digest,
        len(pictures),
        camera,
        frames or (lambda: pictures),
        [].append if said is None else said.append,
    )


def never():
    raise AssertionError("the pictures were requested")


def test_a_run_waits_for_the_features_that_another_one_computes(source, dataset, tmp_path):
    computed, begun = [], threading.Event()
    pictures = np.asarray(dataset.observation.images["camera"])

    def slow():
        begun.set()
        computed.append(time.sleep(0.5))
        return pictures

    first = threading.Thread(
        target=features, args=(source, dataset, tmp_path), kwargs={"frames": slow}
    )
    first.start()
    begun.wait()
    second = features(source, dataset, tmp_path, frames=never)
    first.join()
    assert len(computed) == 1
    np.testing.assert_array_equal(second, features(source, dataset, tmp_path, frames=never))


@pytest.fixture(scope="module")
def seen(source, dataset, tmp_path_factory):
    """The dataset with features in the place of pictures."""
    found = features(source, dataset, tmp_path_factory.mktemp("seen"))
    observation = dataset.observation._replace(images=None, features=jnp.asarray(found))
    return dataset.replace(observation=observation)


@pytest.mark.parametrize("name", ["stardiff", "dp_rcm1"])
def test_inference_sees_the_features_that_training_saw(source, dataset, seen, name):
    settings, found = source
    policy = policies.make(METHODS[name], settings, fakes.TASK, TRAIN)
    stats = normalizer.fit(METHODS[name], fakes.TASK, dataset, np.arange(80))
    params = jax.jit(policy.init, compiler_options=QUICK)(jax.random.key(0))
    sample = jax.jit(policy.sample, compiler_options=QUICK)
    keys, frames = jax.random.split(jax.random.key(1), 3), jnp.array([3, 25, 70])

    def say(data, params):
        batch = windows.gather(data, frames, 2, 16)
        return sample(params, stats, keys, batch.observation, batch.trocar).pose.p

    from_features = say(seen, params)
    from_frames = say(dataset, {**params, "vision": found.params})
    np.testing.assert_allclose(from_frames, from_features, atol=1e-5)
    rolled = jnp.roll(seen.observation.features, 1, axis=0)
    others = seen.replace(observation=seen.observation._replace(features=rolled))
    assert np.abs(say(others, params) - from_features).max() > 1e-4


def test_features_are_computed_once(source, dataset, tmp_path):
    first = features(source, dataset, tmp_path)
    assert first.shape == (80, 16) and first.dtype == np.float32 and first.std() > 0
    said = []
    again = features(source, dataset, tmp_path, frames=never, said=said)
    np.testing.assert_array_equal(again, first)
    assert len(said) == 1 and "reused" in said[0]


def test_a_killed_run_goes_on_and_damage_is_mended(source, dataset, tmp_path, monkeypatch):
    monkeypatch.setattr(frozen, "PART", 30)
    monkeypatch.setattr(redraw, "CPU_BATCH", 8)
    whole = features(source, dataset, tmp_path)
    parts = sorted(tmp_path.glob("features/*/part_*.npz"))
    content = [part.read_bytes() for part in parts]
    assert len(parts) == 3
    parts[0].unlink()  # as a kill would leave it
    parts[1].write_bytes(content[1][:200] + bytes([content[1][200] ^ 4]) + content[1][201:])
    np.savez(parts[2], features=np.zeros((3, 16), np.float32))
    said = []
    np.testing.assert_array_equal(features(source, dataset, tmp_path, said=said), whole)
    assert [part.read_bytes() for part in parts] == content
    damaged = [line for line in said if "damaged" in line]
    assert len(damaged) == 2 and parts[1].name in damaged[0] and "expected" in damaged[1]


def test_another_encoder_crop_or_dataset_has_features_of_its_own(source, dataset, tmp_path):
    settings, found = source
    shifted = jax.tree.map(lambda x: 1.1 * x, found.params)
    other = encoder.Encoder(shifted, policy_file.fingerprint(shifted)[:16])
    for kwargs in (
        {},
        {"source": (settings, other)},
        {"source": (dataclasses.replace(settings, crop_fraction=0.8), found)},
        {"camera": "wrist"},
        {"digest": "other"},
        {"source": (dataclasses.replace(settings, dtype="bfloat16"), found)},
    ):
        features(**{"source": source, "dataset": dataset, "root": tmp_path, **kwargs})
    assert len(list((tmp_path / "features").iterdir())) == 6
    features(source, dataset, tmp_path, frames=never)


def run_config(settings, out):
    scene = config.SceneConfig(camera=("camera",))
    changed = {"out": str(out), "scene": scene, "policy": settings, "train": TRAIN}
    return dataclasses.replace(presets.PRESETS["smoke"], **changed)


def train(source, seen, out, name):
    """The part of `starjax train` after the features."""
    settings, found = source
    work = pipeline.RunContext(run_config(settings, out), found, sharing.ALONE, "")
    vars(work)["env"] = fakes.env()  # in place of the cached one
    pipeline._train(work, name, lambda: seen)
    return folders.weights(out, name)


@pytest.fixture(scope="module")
def whole(source, seen, tmp_path_factory):
    out = tmp_path_factory.mktemp("whole")
    return train(source, seen, out, "stardiff")


def test_training_leaves_the_encoder_as_it_was(source, whole):
    found = policy_file.load(whole)
    before = jax.tree_util.tree_leaves_with_path(source[1].params)
    after = dict(jax.tree_util.tree_leaves_with_path(found.params["vision"]))
    assert len(after) == len(before) > 10
    for path, leaf in before:
        assert np.asarray(leaf).tobytes() == np.asarray(after[path]).tobytes(), path
    assert found.policy == source[0] and found.demos == presets.PRESETS["smoke"].demos
    assert found.preset == "smoke"


def test_the_encoder_has_no_optimiser_and_no_average(source, whole):
    manifest = checkpoint.verify(checkpoint.path_of(whole.parent / "checkpoints", 6))
    names = " ".join(manifest["leaves"])
    assert "unet" in names and "vision" not in names and "trunk" not in names


def test_the_rest_learns(source, whole):
    policy = policies.make(METHODS["stardiff"], source[0], fakes.TASK, TRAIN)
    assert "vision" not in jax.eval_shape(policy.init, jax.random.key(0))
    lines = log.read(whole.parent / "metrics.jsonl")
    assert {"train", "holdout"} == {line["kind"] for line in lines}
    kernel = policy_file.load(whole).params["learner"]["unet"]
    begun = state.init(policy, state.streams(0).params).drawn()["learner"]["unet"]
    moved = jax.tree.map(lambda a, b: float(jnp.abs(a - b).max()), kernel, begun)
    assert max(jax.tree.leaves(moved)) > 1e-3


def test_interrupted_and_resumed_is_the_same_policy(source, seen, whole, tmp_path):
    asked = iter(range(100))
    with pytest.raises(KeyboardInterrupt):
        loop.run(
            METHODS["stardiff"],
            source[0],
            TRAIN,
            seen,
            fakes.TASK,
            tmp_path / "stardiff",
            0,
            should_stop=lambda: next(asked) == 2,
        )
    assert train(source, seen, tmp_path, "stardiff").read_bytes() == whole.read_bytes()


def test_a_single_model_trains_on_features_too(source, seen):
    policy = policies.make(METHODS["dp_rcm1"], source[0], fakes.TASK, TRAIN)
    stats = normalizer.fit(METHODS["dp_rcm1"], fakes.TASK, seen, np.arange(80))
    params = jax.jit(policy.init, compiler_options=QUICK)(jax.random.key(0))
    batch = windows.gather(seen, jnp.array([3, 25, 70]), 2, 16)
    given = policy.prepare(stats, jax.random.key(1), batch)
    gradient = jax.jit(jax.grad(policy.loss, has_aux=True), compiler_options=QUICK)
    found, _ = gradient(params, given)
    assert set(found) == {"state", "learner"}
    assert all(np.abs(leaf).max() > 0 for leaf in jax.tree.leaves(found))


def test_a_run_reads_pictures_for_the_features_alone(source, dataset, tmp_path, monkeypatch):
    def without_images(root, images, report, **_):
        assert not images
        blind = dataset.replace(observation=dataset.observation._replace(images=None))
        return load.Demos(blind, "digest", "device", 0, {"scene": {"cameras": ["camera"]}})

    monkeypatch.setattr(load, "verify", lambda root: None)
    monkeypatch.setattr(load, "load", without_images)
    images = {"camera": np.asarray(dataset.observation.images["camera"])}
    monkeypatch.setattr(load, "frames", lambda root, env: images)
    settings, found = source
    env = stubs.make_env("image")
    loaded = demonstrations.load(
        run_config(settings, tmp_path), env, tmp_path, lambda: None, found, sharing.ALONE
    )
    assert loaded.observation.images is None and windows.on_device(loaded)
    wanted = features(source, dataset, tmp_path / "other")
    np.testing.assert_array_equal(loaded.observation.features, wanted)
    assert "features" in pipeline.stage_times.read(tmp_path)


def test_pictures_in_the_place_of_features_are_an_error(source, dataset, tmp_path):
    with pytest.raises(ValueError, match=r"observation.features: expected .*frozen"):
        loop.run(METHODS["stardiff"], source[0], TRAIN, dataset, fakes.TASK, tmp_path, 0)


def test_every_frame_has_its_own_features(source, dataset, tmp_path, monkeypatch):
    monkeypatch.setattr(frozen, "PART", 30)  # parts of batches that its end cuts
    settings, found = source
    see = functools.partial(frozen._see_program(settings), found.params)
    pictures = np.asarray(dataset.observation.images["camera"])
    wanted = np.concatenate([see(pictures[first : first + 16]) for first in range(0, 80, 16)])
    np.testing.assert_allclose(features(source, dataset, tmp_path), wanted, atol=1e-5)
