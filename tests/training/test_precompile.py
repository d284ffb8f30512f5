"""The step that is compiled before its demonstrations are there is the step of the training."""

import dataclasses
import sys
from pathlib import Path

import fakes
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax.core.methods import METHODS
from starjax.data import windows
from starjax.policies import features
from starjax.training import loop, precompile, start, step

sys.path.insert(0, str(Path(__file__).parent))
import jobs  # in this folder, for processes to run

SEES = dataclasses.replace(fakes.TINY, observation="image")


@pytest.mark.parametrize("arms", [1, 2])
@pytest.mark.parametrize("settings", [fakes.TINY, SEES])
def test_shapes_of_batches_are_those_of_gathered_ones(arms, settings):
    task = fakes.task(arms)
    size = settings.image_size if settings is SEES else 0
    dataset = fakes.dataset(seed=0, demos=2, arms=arms, image_size=size)
    if size:
        dataset = dataset.replace(observation=dataset.observation._replace(state=None))
    frames = np.arange(7, dtype=np.int32)
    gathered = jax.eval_shape(
        lambda data: windows.gather(
            data, jnp.asarray(frames), settings.obs_horizon, settings.horizon
        ),
        dataset,
    )
    shapes = precompile.batch_shapes(settings, 7, features.select_sensors(task))
    bare = [jax.tree.map(lambda x: (x.shape, x.dtype), tree) for tree in (shapes, gathered)]
    assert bare[0] == bare[1]


def test_a_training_takes_the_step_that_is_ready(tmp_path, monkeypatch):
    made = jobs._quadratic_policy()
    monkeypatch.setattr(loop.policies, "make", lambda *_, **__: made)
    given = METHODS["stardiff"], SEES, jobs.SETTINGS, fakes.TASK

    def train(folder, **more):
        return jobs.train(tmp_path / folder, observation="image", **more).state

    usual = train("usual")
    program = precompile.step_program(*given, ())
    monkeypatch.setattr(step, "batch_program", None)
    monkeypatch.setattr(program, "_function", None)
    found = train("ahead", step_program=program)
    for one, other in zip(jax.tree.leaves(found.params), jax.tree.leaves(usual.params)):
        np.testing.assert_array_equal(one, other)


FROZEN = dataclasses.replace(SEES, freeze_encoder=True)


@pytest.mark.parametrize("settings", [fakes.TINY, FROZEN])
def test_shapes_of_a_dataset_are_those_of_the_loaded_one(settings):
    seen = features.select_sensors(fakes.TASK)
    dataset = fakes.dataset(seed=0, demos=2, length=5)
    if settings is FROZEN:
        found = jnp.zeros((10, settings.vision_dim))
        dataset = dataset.replace(observation=dataset.observation._replace(features=found))
    dataset = start.observed(dataset, settings, seen)
    shapes = precompile.dataset_shapes(settings, 2, 10, seen)
    bare = [jax.tree.map(lambda x: (x.shape, x.dtype), tree) for tree in (shapes, dataset)]
    assert bare[0] == bare[1]


def test_steps_in_a_loop_are_ready_before_the_data_are_known(tmp_path, monkeypatch):
    made = jobs._quadratic_policy()
    monkeypatch.setattr(loop.policies, "make", lambda *_, **__: made)
    given = METHODS["stardiff"], fakes.TINY, jobs.SETTINGS, fakes.TASK, ()
    assert precompile.step_program(*given) is None
    usual = jobs.train(tmp_path / "usual").state
    whole = fakes.dataset(seed=0)
    room, frames = windows.padded_count(300), len(whole.episode)

    def padded(seed, image_size):
        per_frame = whole.observation, whole.command, whole.episode
        observation, command, episode = jax.tree.map(
            lambda x: jnp.pad(x, [(0, room - frames)] + [(0, 0)] * (x.ndim - 1)), per_frame
        )
        return whole.replace(observation=observation, command=command, episode=episode)

    program = precompile.step_program(*given, len(whole.start), room)
    monkeypatch.setattr(step, "loop_program", None)
    monkeypatch.setattr(program, "_function", None)
    monkeypatch.setattr(fakes, "dataset", padded)
    found = jobs.train(tmp_path / "ahead", step_program=program).state
    for one, other in zip(jax.tree.leaves(found.params), jax.tree.leaves(usual.params)):
        np.testing.assert_allclose(one, other, rtol=1e-6)  # programs of two sizes may round apart
