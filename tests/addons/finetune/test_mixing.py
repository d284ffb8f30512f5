"""Demonstrations and rollouts as one dataset: draws of a batch, and the normaliser."""

import dataclasses
import tracemalloc

import fakes
import jax
import numpy as np
import pytest

from starjax.addons.finetune import mixing
from starjax.core import config
from starjax.core.methods import METHODS
from starjax.data import normalizer, redraw, windows
from starjax.data.episode_array import EpisodeArray

SETTINGS = config.TrainConfig(holdout_demos=2, window_stride=3)
ROW = METHODS["stardiff"]
PIXELS = 64


def on_host(dataset):
    """A part without images."""
    return mixing.Part(jax.tree.map(np.asarray, dataset))


def drawn(frames):
    """Images whose pixels are the numbers of their frames."""

    def draw(qpos, episode):
        whole = np.broadcast_to(qpos[:, :, None, None], (len(qpos), PIXELS, PIXELS, 3))
        return whole.astype(np.uint8)

    qpos = np.arange(frames, dtype=np.float32)[:, None]
    return redraw.DrawnImages(draw, qpos, np.zeros(frames, np.int32), PIXELS)


def read(frames, demos, folder):
    """Images of files, each with its own."""
    length = np.full(demos, frames // demos)
    paths = [folder / f"{demo}.npy" for demo in range(demos)]
    for demo, path in enumerate(paths):
        np.save(path, np.full((length[demo], PIXELS, PIXELS, 3), 100 + demo, np.uint8))
    return EpisodeArray(paths, np.cumsum(length) - length, length)


@pytest.fixture(scope="module")
def parts():
    """Demonstrations, and rollouts whose first two frames of each episode are a policy's."""
    demonstrations, rollouts = fakes.dataset(seed=0), fakes.dataset(seed=1, demos=3, length=10)
    actor = np.tile(np.arange(10) >= 2, 3).astype(np.uint8)
    return demonstrations, rollouts, mixing.learned_frames(actor, "intervention")


@pytest.fixture(scope="module")
def begun(parts):
    demonstrations, rollouts, frames = parts
    fitted = normalizer.fit(ROW, fakes.TASK, demonstrations, np.arange(240))
    half = normalizer.MinMax(0.5 * fitted.action.low, 0.5 * fitted.action.high)
    stats = fitted.replace(action=half)
    params = {"learner": np.ones(2), "vision": np.ones(2)}
    given = (params, stats, on_host(demonstrations), [(on_host(rollouts), frames)])
    return stats, *mixing.start(ROW, fakes.TINY, SETTINGS, *given)


@pytest.mark.parametrize("place", ["device", "host", "disk", "gpu"])
def test_windows_of_each_part_are_those_of_the_part_alone(parts, place, monkeypatch, tmp_path):
    if place == "gpu":  # whose images are put there batch by batch
        place = "device"
        monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
        monkeypatch.setattr(redraw, "GPU_BATCH", 100)
    monkeypatch.setattr(mixing.load, "place_for", lambda total: place)
    demonstrations, rollouts = map(on_host, parts[:2])
    some = [
        demonstrations._replace(images={"camera": drawn(240)}),
        rollouts._replace(images={"camera": read(30, 3, tmp_path)}),
    ]
    whole = mixing.joined(some)
    assert windows.on_device(whole) == (place == "device")
    for part, first in zip(some, (0, 240)):
        frame = np.arange(int(np.sum(part.dataset.length)), dtype=np.int32)
        images = {"camera": part.images["camera"][frame]}
        observation = part.dataset.observation._replace(images=images)
        alone = windows.gather(part.dataset.replace(observation=observation), frame, 2, 4)
        together = windows.gather(whole, frame + first, 2, 4)
        jax.tree.map(np.testing.assert_array_equal, alone, together)


def test_the_images_of_all_parts_exist_once(parts, monkeypatch):
    monkeypatch.setattr(mixing.load, "place_for", lambda total: "host")
    demonstrations, rollouts = map(on_host, parts[:2])
    counts = [240, 30]
    some = [
        part._replace(images={"camera": drawn(count)})
        for part, count in zip((demonstrations, rollouts), counts)
    ]
    union = sum(counts) * PIXELS * PIXELS * 3
    tracemalloc.start()
    whole = mixing.joined(some)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert whole.observation.images["camera"].nbytes == union
    assert peak < 1.2 * union, peak / union


def test_half_of_a_batch_is_rollouts_and_none_is_held_out_or_a_policys(begun):
    _, dataset, start = begun
    others = start.frames[start.frames >= 240]
    assert 2 * len(others) == len(start.frames)
    assert set(others - 240) == {frame for frame in range(30) if frame % 10 >= 2}
    demonstrated = start.frames[start.frames < 240]
    assert (demonstrated % 30 % 3 == 0).all() and not set(demonstrated) & set(start.held_out)
    episodes = np.asarray(dataset.episode)
    assert not set(episodes[demonstrated]) & set(episodes[start.held_out])


def test_few_frames_are_not_learned_by_heart():
    frames = mixing.evenly(np.arange(1000), np.array([2000, 2001]))
    assert (frames < 2000).sum() == 1000 and (frames >= 2000).sum() == 2 * mixing.MAX_REPEATS


def test_a_normaliser_keeps_its_scale_and_reaches_the_rollouts(begun, parts):
    stats, dataset, start = begun
    before, after = stats.action, start.stats.action
    np.testing.assert_array_equal(before.low, after.low)
    np.testing.assert_array_equal(before.high, after.high)
    frames = np.unique(start.frames[start.frames >= 240])
    command = jax.tree.map(lambda leaf: leaf[frames], dataset.command)
    trocar = jax.tree.map(lambda leaf: leaf[dataset.episode[frames]], dataset.trocar)
    scaled = before.normalize(
        normalizer.encode(ROW.action_space, command.pose, command.gripper, trocar)
    )
    low, high = np.asarray(after.reach)
    np.testing.assert_allclose(low, np.minimum(scaled.min(0), -1), atol=1e-5)
    np.testing.assert_allclose(high, np.maximum(scaled.max(0), 1), atol=1e-5)
    assert high.max() > 1.01 or low.min() < -1.01  # the law above is not empty


def test_a_frozen_encoder_stays_out_of_the_state(parts):
    demonstrations, rollouts, frames = parts
    stats = normalizer.fit(ROW, fakes.TASK, demonstrations, np.arange(240))
    params = {"learner": np.ones(2), "vision": np.ones(2)}
    for frozen in (False, True):
        policy = dataclasses.replace(fakes.TINY, freeze_encoder=frozen)
        given = (params, stats, on_host(demonstrations), [(on_host(rollouts), frames)])
        _, start = mixing.start(ROW, policy, SETTINGS, *given)
        assert ("vision" in start.params) != frozen
