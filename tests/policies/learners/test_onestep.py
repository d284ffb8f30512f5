"""The learner `onestep`: exact where the mean velocity is known, and what its samples return."""

import dataclasses

import fakes
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import repeats

from starjax import config, errors
from starjax.models import flow, shortcut
from starjax.policies.learners import onestep

MEAN, SPREAD = 0.3, 0.2  # of a normal distribution
FAR = 1e9 * np.array([-1.0, 1.0])


def spread(time):
    return jnp.sqrt((1 - time) ** 2 * SPREAD**2 + time**2)


def velocity(x, told, rows=None):
    """What a perfect network predicts of that distribution: on the way of a noise, which is known,
    the mean over the step; at the last level the velocity itself."""
    level = jnp.floor(told / shortcut.LEVEL_UNIT)
    time = (told - shortcut.LEVEL_UNIT * level) * flow.TIME_UNIT
    length = 2.0**-level
    time, length = (n[..., None] if jnp.ndim(n) else n for n in (time, length))
    after = time - length
    standard = (x - (1 - time) * MEAN) / spread(time)
    there = (1 - after) * MEAN + spread(after) * standard
    slope = (time - (1 - time) * SPREAD**2) / spread(time)  # of `spread`
    return jnp.where(length > 2.0**-shortcut.LEVELS, (x - there) / length, slope * standard - MEAN)


@pytest.mark.parametrize("steps", [1, 4, 64])
def test_any_number_of_steps_ends_where_the_way_does(steps):
    noise = jax.random.normal(jax.random.key(0), (64, 2))
    found = shortcut.sample(velocity, noise, steps=steps, reach=FAR)
    np.testing.assert_allclose(found, MEAN + SPREAD * noise, atol=1e-5)


@pytest.mark.parametrize("count", [400, 401, 3])
def test_steps_of_a_perfect_network_add_up(count):
    """Its own targets are what it predicts, but for the last level, whose length is not none."""
    x0 = MEAN + SPREAD * jax.random.normal(jax.random.key(1), (count, 1))
    given = shortcut.noised(jax.random.key(2), x0)
    found = shortcut.targets(velocity, given)
    wanted = velocity(given.x, shortcut.told(given.time, given.level))
    long = np.asarray(given.level) < shortcut.LEVELS - 1
    np.testing.assert_allclose(found[long], wanted[long], atol=1e-4)
    flowing = np.asarray(given.level) == shortcut.LEVELS
    np.testing.assert_array_equal(found[flowing], given.velocity[flowing])
    assert flowing.sum() == count - -(-count // shortcut.EVERY)


def test_steps_begin_where_a_sampler_begins_them():
    given = shortcut.noised(jax.random.key(3), jnp.zeros((4000, 1)))
    steps = np.asarray(given.level) < shortcut.LEVELS
    time, level = np.asarray(given.time)[steps], np.asarray(given.level)[steps]
    place = time * 2.0**level
    np.testing.assert_array_equal(place, np.round(place))
    assert set(level) == set(range(shortcut.LEVELS)) and time.min() > 0 and time.max() == 1.0


def test_a_sample_is_within_reach():
    noise = jax.random.normal(jax.random.key(0), (64, 2))
    found = shortcut.sample(lambda x, _: -1e3 * jnp.sign(x), noise, steps=2)
    np.testing.assert_array_equal(np.abs(found), 1.0)


def test_samples_are_what_was_learned():
    settings = config.with_learner(fakes.TINY, "onestep")
    params, wanted = repeats.learned(settings)
    for steps in (1, 8):
        found = repeats.sampled(config.with_options(settings, shortcut_steps=steps), params)
        assert np.abs(found - wanted).mean() < 0.1


def test_options_that_do_not_go_together_are_named():
    assert onestep.MOST_STEPS == 2**shortcut.LEVELS
    with pytest.raises(errors.UsageError) as caught:
        onestep.check(
            dataclasses.replace(onestep.OnestepConfig(), shortcut_steps=3), config.PolicyConfig()
        )
    assert caught.value.argument == "policy.shortcut_steps"
