"""Images of displaced cameras: those of `starjax stress`, in any order of steps, resumed or not."""

import dataclasses
import os
import subprocess
import sys
from typing import Any

import fakes
import jax
import jax.numpy as jnp
import mistakes
import numpy as np
import pytest

from starjax.core import config
from starjax.core.methods import METHODS
from starjax.core.types import Pose
from starjax.data import redraw, windows
from starjax.evaluation.disturbances import base
from starjax.policies.base import Policy
from starjax.sim.render import CameraImage
from starjax.sim.state import ImageSource
from starjax.training import batches, devices, loop, randomise, redrawing, state
from starjax.training.sharding import Setup, StateLayout

NOTHING: Any = None
KEY, SIZE, BATCH, MOVED = jax.random.key(4), 4, 16, 4
POLICY = dataclasses.replace(fakes.TINY, observation="image")
NAMES = ("camera=10", "smoke=0.5", "observation_delay=4")


def draw(source):
    """Pixels that tell the frame, the episode and the camera's place."""
    here = jnp.concatenate([source.qpos, source.layout[None], 1e4 * source.cameras.p[0]])
    image = jnp.broadcast_to(here.astype(jnp.int32).astype(jnp.uint8), (SIZE, SIZE, 5))
    return {"camera": CameraImage(image)}


def make_setup(*names) -> Setup:
    settings = config.TrainConfig(batch_size=BATCH, randomise=names)
    layout = StateLayout(devices.make_mesh(BATCH), lambda params: params, NOTHING)
    return Setup(NOTHING, NOTHING, POLICY, settings, layout)


@pytest.fixture(scope="module")
def dataset():
    made = fakes.dataset(seed=0, demos=2, length=20)
    places = jnp.array([[[0.01, 0.0, 0.0]], [[0.0, 0.01, 0.0]]])
    cameras = Pose(jnp.broadcast_to(jnp.eye(3), (2, 1, 3, 3)), places)
    episodes = ImageSource(jnp.zeros((2, 0)), jnp.zeros((2, 1, 3)), jnp.arange(2.0), cameras)
    sources = redraw.Sources(jnp.arange(40.0)[:, None], episodes)
    plain = jax.vmap(draw)(sources.at(jnp.arange(40), made.episode))["camera"].rgb
    seen = made.observation._replace(images={"camera": plain})
    return made.replace(observation=seen, sources=sources)


@pytest.fixture(scope="module")
def resident(dataset):
    """Returns a setup, its data, and the functions of its batches and displaced images."""
    setup = make_setup(*NAMES)
    data = (dataset, jnp.arange(40), jnp.int32(40))
    gather = jax.jit(lambda *given: batches.drawn_batch(setup, KEY, *given))
    return setup, data, gather, redrawing.make(setup, draw, data, ahead=False)


def displaced_rows(setup) -> np.ndarray:
    """Samples with displaced cameras: the first ones of every device."""
    shares = np.arange(BATCH).reshape(setup.layout.mesh.size, -1)
    return shares[:, : randomise.redrawn_count(shares.shape[1])].ravel()


def choice(setup, data, number) -> Any:
    return batches.choose(setup, KEY, jnp.int32(number), *data)


def test_a_displaced_camera_is_that_of_a_stressed_episode_with_the_same_key(dataset, resident):
    setup, data, _, displaced = resident
    found = displaced(KEY, 3)
    parts = [part.data.shape[0] for part in found.images["camera"].addressable_shards]
    assert parts == [MOVED // setup.layout.mesh.size] * setup.layout.mesh.size
    images = np.asarray(found.images["camera"][:, found.index])
    assert images.shape == (MOVED, 2, SIZE, SIZE, 5)
    chosen = choice(resident[0], data, 3)
    episode = np.asarray(dataset.episode)[chosen.frame]
    for image, i in zip(images, displaced_rows(setup), strict=True):
        start = base.start("camera", chosen.draws.level[i, 0], chosen.draws.key[i])
        cameras = jax.tree.map(lambda x, i=i: x[episode[i]], dataset.sources.episodes.cameras)
        stressed = base.DISTURBANCES.get("camera").on_camera(start, cameras)
        for at, seen in enumerate(np.asarray(chosen.seen)[i]):
            source = dataset.sources.at(20 * episode[i] + seen, episode[i])
            wanted = draw(source._replace(cameras=stressed))["camera"].rgb
            np.testing.assert_allclose(image[at].astype(int), wanted.astype(int), atol=1)
    assert len(np.unique(images[:, :, 0, 0, 2:].reshape(MOVED * 2, -1), axis=0)) == MOVED


def test_the_other_samples_have_their_recorded_bytes(dataset, resident):
    setup, data, gather, displaced = resident
    chosen, batch = choice(setup, data, 3), gather(jnp.int32(3), *data, displaced(KEY, 3))
    plain = windows.gather(dataset, chosen.frame, 2, POLICY.horizon, chosen.seen)
    images, usual = ((it.observation.images or {})["camera"] for it in (batch, plain))
    undisturbed = ~np.asarray(chosen.draws.level).any(axis=1)
    assert undisturbed.sum() >= BATCH // 2
    np.testing.assert_array_equal(images[undisturbed], usual[undisturbed])
    moved = displaced_rows(setup)
    assert not np.array_equal(images[moved], usual[moved])
    jax.tree.map(np.testing.assert_array_equal, batch.command, plain.command)


def test_two_devices_draw_their_shares():
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count=2"
    names = "displaced_camera_is_that or other_samples_have"
    command = [sys.executable, "-m", "pytest", "-q", __file__, "-k", names]
    subprocess.run(command, env={**os.environ, "XLA_FLAGS": flags}, check=True)


def test_images_depend_on_the_step_alone(resident, monkeypatch):
    setup, data, _, _ = resident
    monkeypatch.setitem(redrawing.AT_ONCE, "cpu", 4 * MOVED * 2)  # four steps
    through, resumed = (redrawing.make(setup, draw, data, ahead=False) for _ in range(2))
    whole = [through(KEY, number) for number in range(8)]
    assert [int(it.index) for it in whole] == [0, 1, 2, 3] * 2
    again = resumed(KEY, 6)
    np.testing.assert_array_equal(
        again.images["camera"][:, again.index], whole[6].images["camera"][:, 2]
    )
    single = resident[3](KEY, 6)  # one step at a time
    np.testing.assert_array_equal(single.images["camera"][:, 0], whole[6].images["camera"][:, 2])


def test_streamed_batches_are_the_resident_ones(dataset, resident):
    setup, data, gather, displaced = resident
    on_host = jax.tree.map(np.asarray, dataset)
    stream = batches.gathered(setup, on_host, np.arange(40), KEY, 2)
    places = (windows.places(dataset), *data[1:])
    for number in (2, 3):
        images = displaced(KEY, number)
        wanted = gather(jnp.int32(number), *data, images)
        found = batches._disturbed(setup, KEY, jnp.int32(number), next(stream), images, *places)
        jax.tree.map(np.testing.assert_array_equal, found, wanted)
    stream.close()


def test_without_names_a_batch_is_what_it_was(dataset):
    data = (dataset, jnp.arange(40), jnp.int32(40))
    batch = batches.drawn_batch(make_setup(), KEY, jnp.int32(5), *data)
    frame = windows.sample_frames(state.step_keys(KEY, jnp.int32(5)).batch, data[1], BATCH)
    jax.tree.map(np.testing.assert_array_equal, batch, windows.gather(dataset, frame, 2, 16))


class Stop:
    """Callable that is True at its n-th call."""

    def __init__(self, asks):
        self.asks = asks

    def __call__(self):
        self.asks -= 1
        return self.asks == 0


def brightness():
    """Returns a policy of one parameter, which every image that it meets moves."""

    def loss(params, batch):
        images = batch.observation.images["camera"].astype(jnp.float32)
        weights = jnp.arange(images.size, dtype=jnp.float32).reshape(images.shape)
        return jnp.mean((params["w"] - jnp.mean(images * weights) / images.size) ** 2), {}

    init = lambda key: {"w": jax.random.normal(key, ())}  # noqa: E731
    return Policy(init, lambda stats, key, batch: batch, loss, NOTHING)


@pytest.mark.slow
@pytest.mark.parametrize("on_host", [False, True], ids=["resident", "streamed"])
def test_a_resumed_training_meets_the_same_images(dataset, monkeypatch, tmp_path, on_host):
    monkeypatch.setattr(loop.policies, "make", lambda *_: brightness())
    monkeypatch.setitem(redrawing.AT_ONCE, "cpu", 4 * MOVED * 2)  # four steps
    given = jax.tree.map(np.asarray, dataset) if on_host else dataset

    def train(directory, names=NAMES, should_stop=lambda: False):
        settings = config.TrainConfig(
            steps=7, batch_size=BATCH, learning_rate=0.1, warmup_steps=0, steps_per_call=2,
            randomise=names, holdout_demos=0,
        )  # fmt: skip
        return loop.run(
            METHODS["stardiff"], POLICY, settings, given, fakes.TASK, directory, 0,
            should_stop=should_stop, draw_images=draw,
        ).state.params["w"]  # fmt: skip

    with pytest.raises(KeyboardInterrupt):
        train(tmp_path / "a", should_stop=Stop(4))
    resumed, whole = train(tmp_path / "a"), train(tmp_path / "b")
    assert float(resumed) == float(whole)
    assert float(whole) != float(train(tmp_path / "c", names=NAMES[1:]))


def test_a_dataset_of_others_has_its_images_disturbed(dataset):
    setup = make_setup("smoke=0.5", "observation_delay=4")
    data = (dataset.replace(sources=None), jnp.arange(40), jnp.int32(40))
    batch, chosen = batches.drawn_batch(setup, KEY, jnp.int32(5), *data), choice(setup, data, 5)
    plain = windows.gather(dataset, chosen.frame, 2, POLICY.horizon, chosen.seen)
    images, usual = ((it.observation.images or {})["camera"] for it in (batch, plain))
    clouded = np.asarray(images != usual).any(axis=(1, 2, 3, 4))
    np.testing.assert_array_equal(clouded, chosen.draws.level[:, 0] > 0)
    assert clouded.any()


def test_a_dataset_of_others_has_no_displaced_cameras(dataset):
    setup, frames = make_setup(*NAMES), np.arange(40)
    for given, function in ((dataset, None), (dataset.replace(sources=None), draw)):
        data = (given, frames, np.int32(40))
        with mistakes.of("train.randomise"):
            redrawing.make(setup, function, data, False)
    both = config.TrainConfig(randomise=(*NAMES, "look=1"))
    assert randomise.redraws(both) and randomise.redrawn_names(both) == ["camera", "look"]
    assert not randomise.redraws(config.TrainConfig(randomise=NAMES[1:]))
    others = {"features": {"image_camera": {}}, "seed_rule": None}
    with mistakes.of("train.randomise"):
        redraw.expect_possible(randomise.ARGUMENT, others)


def test_both_images_of_a_sample_have_one_look_and_level_0_has_none(dataset):
    def show(source):
        image = jnp.broadcast_to(jnp.uint8(200) * source.has_look, (SIZE, SIZE, 3))
        return {"camera": CameraImage(image)}

    setup, data = make_setup("look=1"), (dataset, jnp.arange(40), jnp.int32(40))
    of, kind = redrawing.make(setup, show, data, ahead=False), base.DISTURBANCES.get("look")
    shown, stressed = [], []
    for number in range(24):
        drawn, draws = of(KEY, number), choice(setup, data, number).draws
        shown.append(np.asarray(drawn.images["camera"][:, drawn.index]))
        state = [base.start("look", draws.level[i, 0], draws.key[i]) for i in range(MOVED)]
        stressed.append([kind.on_look(it) for it in state])
        assert not draws.level[MOVED:].any()
    assert np.ptp(shown, axis=(2, 3, 4, 5)).max() == 0  # both images, all pixels
    np.testing.assert_array_equal(np.max(shown, axis=(2, 3, 4, 5)) > 0, stressed)
    assert 0.35 < np.mean(stressed) < 0.65  # levels are uniform up to 1
    none = randomise.Draws(jnp.zeros(1), KEY)
    assert not randomise.has_look(["look"], none)
    assert randomise.has_look(["smoke"], none) is None
