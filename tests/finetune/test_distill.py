"""Distillation: the student comes nearer to its own flow, which stays as it was."""

import dataclasses

import fakes
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax import config, methods
from starjax.finetune import distill, policy_gradient
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
    key, student = jax.random.key(0), distill.begin(TRAIN, params)
    before = jax.tree.map(jnp.copy, params)
    errors = []
    for first in range(0, 200, 50):
        student, error = learn(student, params, stats, demonstrations, key, first, 50)
        errors.append(float(error))
    assert errors[-1] < 0.9 * errors[0], errors
    jax.tree.map(np.testing.assert_array_equal, params, before)
