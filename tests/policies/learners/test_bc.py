"""The learner `bc`: its loss by hand, and its samples."""

import fakes
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import repeats

from starjax.core import config
from starjax.policies.models import regression

SPREAD = 0.1


@pytest.fixture
def mixture():
    logits = jax.random.normal(jax.random.key(0), (4, 3))
    return regression.Mixture(logits, 0.2 * jax.random.normal(jax.random.key(1), (4, 3, 8, 2)))


def test_the_loss_is_the_likelihood_of_a_mixture_of_normal_distributions(mixture):
    x0 = 0.2 * jax.random.normal(jax.random.key(2), (4, 8, 2))
    found = float(regression.loss(mixture, x0, SPREAD))
    logits, means, x0 = (np.asarray(x, np.float64) for x in (*mixture, x0))
    share = np.exp(logits) / np.exp(logits).sum(1, keepdims=True)
    density = np.exp(-((means - x0[:, None]) ** 2).mean((2, 3)) / (2 * SPREAD**2))
    wanted = -2 * SPREAD**2 * np.log((share * density).sum(1)).mean()
    np.testing.assert_allclose(found, wanted, rtol=1e-5)


@pytest.mark.parametrize("spread", [0.01, 1.0])
def test_with_one_component_it_is_the_squared_error(mixture, spread):
    x0 = jnp.full((4, 8, 2), 0.3)
    one = regression.Mixture(mixture.logits[:, :1], mixture.means[:, :1])
    found = regression.loss(one, x0, spread)
    np.testing.assert_allclose(found, jnp.mean((one.means[:, 0] - x0) ** 2), rtol=1e-5)


def test_components_are_drawn_as_often_as_they_are_likely():
    keys = jax.random.split(jax.random.key(3), 4000)
    logits = jnp.broadcast_to(jnp.log(jnp.array([0.6, 0.3, 0.1])), (4000, 3))
    means = jnp.broadcast_to(jnp.arange(3.0)[:, None, None], (4000, 3, 1, 1))
    found = np.bincount(
        regression.draw(regression.Mixture(logits, means), keys).astype(int).ravel()
    )
    np.testing.assert_allclose(found / 4000, [0.6, 0.3, 0.1], atol=0.03)


def small(**changed):
    settings = config.with_learner(fakes.TINY, "bc")
    return config.with_options(settings, mlp_width=32, mlp_blocks=1, **changed)


def test_samples_are_what_was_learned():
    params, wanted = repeats.learned(small())
    assert np.abs(repeats.sampled(small(), params) - wanted).mean() < 0.05


def test_a_mixture_learns_two_ways_from_one_place():
    """Regression would say their mean, 0."""
    model = repeats.model(small(components=4))
    seen = repeats.condition(jnp.zeros((64, 2)))
    ways = jnp.where(jnp.arange(64) % 2, 0.8, -0.8)[:, None, None]
    x0 = jnp.broadcast_to(ways, (64, fakes.TINY.horizon, repeats.ACTION))
    optimizer = optax.adam(1e-2)

    @jax.jit
    def train(key):
        params = model.init(key)

        def step(_, carry):
            params, state = carry
            gradient = jax.grad(lambda params: model.loss(params, seen, x0)[0])(params)
            updates, state = optimizer.update(gradient, state)
            return optax.apply_updates(params, updates), state

        return jax.lax.fori_loop(0, 300, step, (params, optimizer.init(params)))[0]

    params = train(jax.random.key(0))
    found = np.asarray(model.sample(params, jax.random.split(jax.random.key(1), 64), seen, None))
    assert (np.abs(np.abs(found) - 0.8) < 0.1).mean() > 0.95
    assert 0.25 < (found[:, 0, 0] > 0).mean() < 0.75
