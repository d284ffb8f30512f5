"""The conditional diffusion model as a whole: what its loss learns, its samples return."""

import dataclasses

import fakes
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from starjax.models import diffusion, schedule
from starjax.models.kernels import parallel_ddim
from starjax.policies import diffuser, features

ACTION = 2
STEPS = 400
PRESENT = jnp.array([[0.7, -0.6], [-0.5, 0.8]])  # of two samples


@pytest.fixture(scope="module")
def learned():
    """A model with the parameters that repeat two sequences, the sequences, and their inputs."""
    settings = dataclasses.replace(fakes.TINY, observation="state")
    model = diffuser.make(settings, ACTION, ACTION, 0)
    ramp = jnp.linspace(0.0, 0.2, settings.horizon)[:, None]
    wanted = PRESENT[:, None] + ramp * jnp.array([1.0, -1.0])
    history = jnp.repeat(PRESENT[:, None], settings.obs_horizon, axis=1)
    optimizer = optax.adam(optax.cosine_decay_schedule(1e-2, STEPS))

    def repeated(x):
        return jnp.repeat(x, 16, axis=0)

    def loss(params, inputs, given):
        return model.loss(params, model.observe(params, inputs), jnp.zeros((32, 0)), given)

    def step(i, carry):
        params, state = carry
        inputs = features.Inputs(repeated(history), None, None)
        given = model.noised(jax.random.fold_in(jax.random.key(1), i), repeated(wanted))
        gradient = jax.grad(loss)(params, inputs, given)
        updates, state = optimizer.update(gradient, state, params)
        return optax.apply_updates(params, updates), state

    @jax.jit
    def train(key):
        params = model.init(key)
        return jax.lax.fori_loop(0, STEPS, step, (params, optimizer.init(params)))[0]

    return settings, train(jax.random.key(0)), wanted, features.Inputs(history, None, None)


def sampled(settings, params, inputs, seed=2):
    model = diffuser.make(settings, ACTION, ACTION, 0)
    keys = jax.random.split(jax.random.key(seed), len(PRESENT))

    @jax.jit
    def sample(params, keys, inputs):
        observed = model.observe(params, inputs)
        return model.sample(params, keys, observed, jnp.zeros((len(PRESENT), 0)))

    return np.asarray(sample(params, keys, inputs))


def test_samples_are_what_was_learned(learned):
    settings, params, wanted, inputs = learned
    found = sampled(dataclasses.replace(settings, ddim_steps=10), params, inputs)
    assert np.abs(found - wanted).mean() < 0.05


def test_samples_are_the_same_where_steps_are_side_by_side(learned, monkeypatch):
    settings, params, _, inputs = learned
    ten = dataclasses.replace(settings, ddim_steps=10)
    wanted, calls = sampled(ten, params, inputs), []
    one_by_one = diffusion.ddim_sample
    monkeypatch.setattr(diffusion, "ddim_sample", lambda *a, **k: calls.append(a))
    monkeypatch.setattr(parallel_ddim, "pays", lambda batch, steps: (batch, steps) == (2, 10))
    found = sampled(ten, params, inputs)
    np.testing.assert_allclose(found, wanted, atol=0.01)
    assert np.abs(found - wanted).max() > 0 and calls == []
    monkeypatch.setattr(diffusion, "ddim_sample", one_by_one)
    five = dataclasses.replace(settings, ddim_steps=5)
    monkeypatch.setattr(parallel_ddim, "ddim_sample", lambda *a, **k: calls.append(a))
    sampled(five, params, inputs)
    assert calls == []


def test_at_temperature_zero_no_sample_depends_on_its_key(learned):
    settings, params, _, inputs = learned
    cold = dataclasses.replace(settings, ddim_steps=10, temperature=0.0)
    np.testing.assert_array_equal(
        sampled(cold, params, inputs, 2), sampled(cold, params, inputs, 3)
    )
    warm = dataclasses.replace(cold, temperature=1.0)
    assert np.abs(sampled(warm, params, inputs, 2) - sampled(warm, params, inputs, 3)).max() > 1e-4


def test_a_sample_starts_as_the_settings_say():
    """A network that predicts no noise leaves what a sample starts from, scaled."""
    settings = dataclasses.replace(fakes.TINY, diffusion_steps=50, ddim_steps=5, temperature=0.25)
    model = diffuser.make(settings, ACTION, ACTION, 0)
    shapes = jax.eval_shape(model.init, jax.random.key(0))
    params = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape), shapes)
    keys = jax.random.split(jax.random.key(2), 2)
    given = (jnp.zeros((2, diffuser.observed_dim(settings, cameras=1))), jnp.zeros((2, 0)))
    found = jax.jit(model.sample)(params, keys, *given, 1e9 * jnp.array([[-1.0], [1.0]]))
    start = 0.25 * diffusion.sample_noise(keys, (settings.horizon, ACTION))
    first = schedule.ddim_table(50, 5).sqrt_alpha_bar[0]
    np.testing.assert_allclose(found, start / first, rtol=1e-4)
    k = model.noised(jax.random.key(3), jnp.zeros((1024, 1))).k
    assert set(k.tolist()) == set(range(50))


def test_networks_are_as_the_settings_say():
    def shapes(**changed):
        model = diffuser.make(dataclasses.replace(fakes.TINY, **changed), ACTION, ACTION, 0)
        return jax.eval_shape(model.init, jax.random.key(0))

    block = shapes(kernel_size=3)["unet"]["params"]["down_0_0"]["ConvBlock_0"]["Conv1d_0"]
    assert block["kernel"].shape[0] == 3
    with pytest.raises(ValueError, match=r"groups: expected a divisor of 16 channels, got 3"):
        shapes(groups=3)
    inputs = features.Inputs(jnp.ones((1, 2, ACTION)))
    half = diffuser.make(dataclasses.replace(fakes.TINY, dtype="bfloat16"), ACTION, ACTION, 0)
    exact = diffuser.make(fakes.TINY, ACTION, ACTION, 0)
    params = {"state": exact.init(jax.random.key(0))["state"]}
    assert (half.observe(params, inputs) != exact.observe(params, inputs)).any()
