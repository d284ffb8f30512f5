"""Demonstrations and rollouts as one dataset: what is drawn, and what a normaliser keeps."""

import dataclasses

import fakes
import jax
import mistakes
import numpy as np
import pytest

from starjax import config
from starjax.data import normalizer, windows
from starjax.finetune import mixing
from starjax.methods import METHODS

SETTINGS = config.TrainConfig(holdout_demos=2, window_stride=3)
ROW = METHODS["stardiff"]


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
    given = (params, stats, demonstrations, [(rollouts, frames)])
    return stats, *mixing.start(ROW, fakes.TINY, SETTINGS, *given)


@pytest.mark.parametrize("on_host", [False, True])
def test_windows_of_each_part_are_those_of_the_part_alone(parts, on_host):
    some = parts[:2]
    if on_host:
        some = [jax.tree.map(np.asarray, part) for part in some]
    whole = mixing.joined(some)
    assert windows.on_device(whole) != on_host
    for part, first in zip(some, (0, 240)):
        frame = np.arange(int(np.sum(part.length)), dtype=np.int32)
        alone, together = (
            windows.gather(d, f, 2, 4) for d, f in ((part, frame), (whole, frame + first))
        )
        jax.tree.map(np.testing.assert_array_equal, alone, together)


def test_half_of_a_batch_is_rollouts_and_none_is_held_out_or_a_policys(begun):
    _, dataset, start = begun
    others = start.frames[start.frames >= 240]
    assert 2 * len(others) == len(start.frames)
    assert set(others - 240) == {frame for frame in range(30) if frame % 10 >= 2}
    demonstrated = start.frames[start.frames < 240]
    assert (demonstrated % 30 % 3 == 0).all() and not set(demonstrated) & set(start.held_out)
    episodes = np.asarray(dataset.episode)
    assert not set(episodes[demonstrated]) & set(episodes[start.held_out])


def test_images_that_stay_on_disk_are_refused(parts):
    on_disk = parts[0].replace(
        observation=parts[0].observation._replace(images={"camera": object()})
    )
    with mistakes.of("the demonstrations"):
        mixing.joined([on_disk, parts[1]])


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
        given = (params, stats, demonstrations, [(rollouts, frames)])
        _, start = mixing.start(ROW, policy, SETTINGS, *given)
        assert ("vision" in start.params) != frozen
