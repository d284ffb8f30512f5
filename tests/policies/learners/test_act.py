"""The learner `act`: its mathematics by hand, and its samples."""

import dataclasses

import fakes
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import repeats

from starjax.core import config, errors
from starjax.policies import sequences
from starjax.policies.learners import act
from starjax.policies.models import transformer

SMALL = config.with_options(
    config.with_learner(fakes.TINY, "act"),
    style_dim=4,
    width=16,
    heads=2,
    mlp=32,
    style_layers=1,
    encoder_layers=1,
    decoder_layers=1,
)


def test_the_divergence_is_the_integral_that_it_stands_for():
    mean, log_variance = np.array([[0.5, -1.0]]), np.array([[0.3, -0.7]])
    grid = np.linspace(-12, 12, 20_001)
    wanted = 0.0
    for m, v in zip(mean[0], np.exp(log_variance[0])):
        log_p = -0.5 * (grid - m) ** 2 / v - 0.5 * np.log(2 * np.pi * v)
        log_q = -0.5 * grid**2 - 0.5 * np.log(2 * np.pi)
        wanted += np.trapezoid(np.exp(log_p) * (log_p - log_q), grid)
    found = transformer.divergence(transformer.Style(jnp.array(mean), jnp.array(log_variance)))
    np.testing.assert_allclose(found, wanted, rtol=1e-5)


def test_styles_are_drawn_from_their_distribution():
    noise = jax.random.normal(jax.random.key(0), (20_000, 1))
    style = transformer.Style(jnp.full((1, 1), 2.0), jnp.full((1, 1), np.log(9.0)))
    found = transformer.drawn(style, noise)
    np.testing.assert_allclose([found.mean(), found.std()], [2.0, 3.0], atol=0.06)


def test_attention_is_the_softmax_of_products():
    """One layer whose MLP and norms do nothing, against numpy."""
    layer = transformer.Layer(heads=1, mlp=4)
    x = jax.random.normal(jax.random.key(1), (1, 3, 4))
    params = layer.init(jax.random.key(2), x)["params"]
    params["narrow"] = jax.tree.map(jnp.zeros_like, params["narrow"])
    found = np.asarray(layer.apply({"params": params}, x))[0]
    x = np.asarray(x, np.float64)[0]
    h = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-6)
    of = params["attend_itself"]
    q, k, v = (h @ np.asarray(of[name]["kernel"])[:, 0] for name in ("query", "key", "value"))
    weights = np.exp(q @ k.T / 2.0)
    weights /= weights.sum(-1, keepdims=True)
    wanted = x + weights @ v @ np.asarray(of["out"]["kernel"])[0]
    np.testing.assert_allclose(found, wanted, atol=1e-5)


@pytest.mark.slow
@pytest.mark.release
def test_samples_are_what_was_learned():
    params, wanted = repeats.learned(SMALL)
    found = repeats.sampled(SMALL, params)
    assert np.abs(found - wanted).mean() < 0.1
    np.testing.assert_array_equal(found, repeats.sampled(SMALL, params, seed=9))


@pytest.mark.slow
def test_a_sequence_depends_on_all_that_is_given():
    """Images, state, trocar and style; in training on the demonstrated sequence itself."""
    sizes = sequences.Sizes(horizon=8, action=2, obs_horizon=2, vision=6, state=5, trocar=7)
    model = act.make(SMALL.options, SMALL, sizes)
    params = model.init(jax.random.key(0))
    given = sequences.Condition(jnp.ones((1, 2, 6)), jnp.ones((1, 5)), jnp.ones((1, 7)))
    keys = jax.random.split(jax.random.key(1), 1)

    def total(condition):
        return model.sample(params, keys, condition, 1e9 * jnp.array([[-1.0], [1.0]])).sum()

    for gradient in jax.grad(total)(given):
        assert (np.abs(gradient) > 0).all()
    x0 = model.prepare(jax.random.key(2), jnp.ones((1, 8, 2)))
    value, metrics = model.loss(params, given, x0)
    assert metrics.keys() == set(model.metrics)
    np.testing.assert_allclose(value, metrics["l1"] + 10 * metrics["divergence"], rtol=1e-6)
    assert set(model.prepare_for_inference(params)) == {"decoder"}


def test_its_usual_size_is_that_of_act():
    settings = config.with_learner(config.PolicyConfig(), "act")
    sizes = sequences.Sizes(horizon=16, action=4, obs_horizon=2, vision=128, state=256, trocar=7)
    shapes = jax.eval_shape(act.make(settings.options, settings, sizes).init, jax.random.key(0))
    assert 5e6 < sum(leaf.size for leaf in jax.tree.leaves(shapes)) < 10e6


def test_options_that_do_not_go_together_are_named():
    options = dataclasses.replace(act.ActConfig(), heads=3)
    with pytest.raises(errors.UsageError) as caught:
        act.check(options, config.PolicyConfig())
    assert caught.value.argument == "policy.width"
