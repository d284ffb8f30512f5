"""The learner `flow`: exact for a known velocity, and its samples."""

import fakes
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import repeats

from starjax.core import config
from starjax.policies.models import flow

MEAN, SPREAD = 0.3, 0.2  # quantile of a normal distribution
FAR = 1e9 * np.array([-1.0, 1.0])


def velocity(x, time):
    """What a perfect network predicts of that distribution."""
    t = time * flow.TIME_UNIT
    off = x - (1 - t) * MEAN
    variance = (1 - t) ** 2 * SPREAD**2 + t**2
    return (t - (1 - t) * SPREAD**2) / variance * off - MEAN


@pytest.fixture(scope="module")
def noise():
    return jax.random.normal(jax.random.key(0), (64, 2))


@pytest.mark.parametrize(("steps", "most"), [(10, 0.1), (100, 0.01), (1000, 0.001)])
def test_samples_of_a_normal_distribution_are_its_own(noise, steps, most):
    """The way of each noise is known; Euler's error falls with the steps."""
    found = flow.sample(velocity, noise, steps=steps, reach=FAR)
    wanted = MEAN + SPREAD * noise
    assert np.abs(found - wanted).max() < most * np.abs(noise).max()


def test_one_step_ends_in_the_mean(noise):
    found = flow.sample(velocity, noise, steps=1, reach=FAR)
    np.testing.assert_allclose(found, jnp.full_like(noise, MEAN), atol=1e-6)


def test_a_sample_is_within_reach(noise):
    found = flow.sample(lambda x, _: -1e3 * jnp.sign(x), noise, steps=5)
    np.testing.assert_array_equal(np.abs(found), 1.0)


def test_the_perfect_velocity_has_the_least_loss():
    x0 = MEAN + SPREAD * jax.random.normal(jax.random.key(1), (20_000, 1))
    given = flow.noised(jax.random.key(2), x0)
    assert given.time.min() >= 0 and given.time.max() <= 1 / flow.TIME_UNIT

    def loss(wrong):
        return flow.velocity_loss(lambda x, t: velocity(x, t[:, None]) + wrong, given)

    least = loss(0.0)
    assert loss(0.1) > least and loss(-0.1) > least
    np.testing.assert_allclose(loss(0.1) + loss(-0.1) - 2 * least, 0.02, rtol=1e-2)


@pytest.mark.slow
def test_samples_are_what_was_learned():
    settings = config.with_learner(fakes.TINY, "flow")
    params, wanted = repeats.learned(settings)
    for steps, most in ((1, 0.1), (10, 0.05)):
        found = repeats.sampled(config.with_options(settings, euler_steps=steps), params)
        assert np.abs(found - wanted).mean() < most
