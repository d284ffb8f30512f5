"""The step that is compiled before its demonstrations are there is the step of the training."""

import dataclasses
import sys
from pathlib import Path

import fakes
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax.data import windows
from starjax.methods import METHODS
from starjax.policies import features
from starjax.training import loop, precompile, stepper

sys.path.insert(0, str(Path(__file__).parent))
import jobs  # it lies beside this file, for processes to run

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
    monkeypatch.setattr(stepper, "batch_program", None)
    monkeypatch.setattr(program, "_function", None)
    found = train("ahead", step_program=program)
    for one, other in zip(jax.tree.leaves(found.params), jax.tree.leaves(usual.params)):
        np.testing.assert_array_equal(one, other)


def test_a_step_in_a_loop_waits_for_its_data():
    given = METHODS["stardiff"], fakes.TINY, jobs.SETTINGS, fakes.TASK
    assert precompile.step_program(*given, ()) is None
