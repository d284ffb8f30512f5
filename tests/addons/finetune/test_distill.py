"""Distillation: the student comes nearer to its own flow, which stays as it was."""

import dataclasses
import types

import fakes
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax.addons.finetune import distill, policy_gradient
from starjax.core import config, methods
from starjax.data import windows
from starjax.policies import policy as policies
from starjax.policies.learners.onestep import OnestepConfig

OPTIONS = OnestepConfig(unet_channels=(16,), time_dim=16, groups=4, temperature=0.5)
SETTINGS = dataclasses.replace(fakes.TINY, learner="onestep", options=OPTIONS)
TRAIN = config.TrainConfig(
    batch_size=16, learning_rate=1e-2, steps=200, warmup_steps=5, ema_max=0.9
)


def test_the_teacher_is_the_same_network_sampled_as_a_flow():
    settings = distill.flow_settings(SETTINGS)
    assert settings.learner == "flow" and settings.options.temperature == 0.5
    same = {"learner": SETTINGS.learner, "options": OPTIONS}
    assert dataclasses.replace(settings, **same) == SETTINGS


@pytest.mark.slow
@pytest.mark.release
def test_the_student_comes_nearer_to_its_flow():
    row = methods.METHODS["dp_rcm4"]
    policy, flow = (
        policies.make(row, settings, fakes.TASK, TRAIN)
        for settings in (SETTINGS, distill.flow_settings(SETTINGS))
    )
    params, dataset = fakes.params(policy), fakes.dataset(4)
    stats = fakes.normalizer.fit(row, fakes.TASK, dataset, np.arange(int(dataset.length.sum())))
    demonstrations = policy_gradient.demonstrated(dataset, 1)
    learn = distill.make(policy, flow, SETTINGS, TRAIN)
    key = jax.random.key(0)
    seen = windows.gather(demonstrations.dataset, demonstrations.frames, 2, SETTINGS.horizon)
    tips = seen.observation.pose._replace(p=seen.observation.pose.p + 0.05)  # m, far from them
    near = distill.Visited(seen.observation, seen.trocar)
    far = near._replace(observation=seen.observation._replace(pose=tips))
    before = jax.tree.map(jnp.copy, params)

    def learned(visited):
        """Returns the student, and the error after each 50 steps."""
        student, errors = distill.begin(TRAIN, params), []
        for first in range(0, 200, 50):
            student, error = learn(student, params, stats, demonstrations, visited, key, first, 50)
            errors.append(float(error))
        return student.average, errors

    keys = jax.random.split(key, len(demonstrations.frames))
    goal = flow.generate(params, stats, keys, *far, True)
    found = []
    for visited in (near, far):
        student, errors = learned(visited)
        assert errors[-1] < 0.9 * errors[0], errors
        found.append(float(jnp.mean((policy.generate(student, stats, keys, *far) - goal) ** 2)))
    assert found[1] < 0.8 * found[0], found  # it comes nearer at visited states
    jax.tree.map(np.testing.assert_array_equal, params, before)


def test_visited_states_are_those_before_an_episodes_end():
    alive = np.array([[True, True, False], [True, False, False]])
    state = jnp.arange(6).reshape(2, 3, 1)
    played = types.SimpleNamespace(alive=alive, observation=state, trocar=jnp.array([7, 8]))
    found = distill.visited(played, np.random.default_rng(0))
    assert set(found.observation[:, 0].tolist()) == {0, 1, 3} and len(found.trocar) == alive.size
    np.testing.assert_array_equal(found.trocar, np.where(found.observation[:, 0] < 3, 7, 8))
