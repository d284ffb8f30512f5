"""The learner `onestep`: its path is that of its flow, and its samples."""

import fakes
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import repeats

from starjax.core import config
from starjax.policies.models import flow, shortcut

MEAN, SPREAD = 0.3, 0.2  # quantile of a normal distribution
FAR = 1e9 * np.array([-1.0, 1.0])


def velocity(x, told, rows=None):
    """What a perfect network predicts of that distribution; on a whole way, where it leads."""
    told = told[..., None] if jnp.ndim(told) else told
    t = told * flow.TIME_UNIT
    variance = (1 - t) ** 2 * SPREAD**2 + t**2
    flowing = (t - (1 - t) * SPREAD**2) / variance * (x - (1 - t) * MEAN) - MEAN
    return jnp.where(told == shortcut.WHOLE_WAY, x - (MEAN + SPREAD * x), flowing)


def test_one_step_ends_where_the_way_does():
    noise = jax.random.normal(jax.random.key(0), (64, 2))
    found = shortcut.sample(velocity, noise, reach=FAR)
    np.testing.assert_allclose(found, MEAN + SPREAD * noise, atol=1e-6)


def test_a_second_evaluation_corrects_errors_of_the_first():
    noise, error, t = jax.random.normal(jax.random.key(0), (64, 2)), 0.4, 0.3

    def wrong(x, told):
        return velocity(x, told) - error * (told == shortcut.WHOLE_WAY)

    once, twice, right = (
        shortcut.sample(predict, noise, correct_at=at, reach=FAR)
        for predict, at in ((wrong, 0.0), (wrong, t), (velocity, t))
    )
    np.testing.assert_allclose(once, MEAN + SPREAD * noise + error, atol=1e-6)
    # The mean of clean sequences given one at t moves with it by this factor.
    gain = (1 - t) * SPREAD**2 / ((1 - t) ** 2 * SPREAD**2 + t**2)
    np.testing.assert_allclose(twice - right, (1 - t) * gain * error, atol=1e-6)
    assert abs(float(twice.mean()) - MEAN) < 0.1 < abs(float(once.mean()) - MEAN)


@pytest.mark.parametrize("count", [400, 401, 3])
def test_the_flow_teaches_the_whole_way(count):
    x0 = MEAN + SPREAD * jax.random.normal(jax.random.key(1), (count, 1))
    given = shortcut.noised(jax.random.key(2), x0)
    found = shortcut.targets(velocity, given)
    whole = np.asarray(given.time) == shortcut.WHOLE_WAY
    start = given.x[whole]
    end = flow.sample(velocity, start, steps=shortcut.TEACHER_STEPS, reach=FAR)
    np.testing.assert_allclose(found[whole], start - end, atol=1e-5)
    np.testing.assert_array_equal(found[~whole], given.velocity[~whole])
    assert whole.sum() == -(-count // shortcut.EVERY)


def test_ways_start_where_samples_of_any_temperature_do():
    given = shortcut.noised(jax.random.key(3), jnp.full((4000, 8), 0.5))
    whole = np.asarray(given.time) == shortcut.WHOLE_WAY
    spread = np.asarray(given.x)[whole].std(axis=1)
    assert spread.min() < 0.05 and spread.max() > 1.0
    time = np.asarray(given.time)[~whole]
    assert time.min() >= 0 and time.max() <= 1 / flow.TIME_UNIT < shortcut.WHOLE_WAY


def test_a_sample_is_within_reach():
    noise = jax.random.normal(jax.random.key(0), (64, 2))
    found = shortcut.sample(lambda x, _: -1e3 * jnp.sign(x), noise)
    np.testing.assert_array_equal(np.abs(found), 1.0)


@pytest.mark.slow
@pytest.mark.release
def test_samples_are_what_was_learned():
    settings = config.with_learner(fakes.TINY, "onestep")
    params, wanted = repeats.learned(settings)
    assert np.abs(repeats.sampled(settings, params) - wanted).mean() < 0.1
