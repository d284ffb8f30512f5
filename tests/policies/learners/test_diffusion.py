"""The learner `diffusion`: its loss, samples and options."""

import dataclasses

import fakes
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import repeats

from starjax.core import config, errors
from starjax.policies.learners import diffusion as learner
from starjax.policies.models import diffusion, schedule


def tiny(**changed):
    return config.with_options(fakes.TINY, **changed)


@pytest.fixture(scope="module")
def learned():
    return repeats.learned(fakes.TINY)


@pytest.mark.slow
def test_samples_are_what_was_learned(learned):
    params, wanted = learned
    found = repeats.sampled(tiny(ddim_steps=10), params)
    assert np.abs(found - wanted).mean() < 0.05


@pytest.mark.slow
def test_samples_are_the_same_where_steps_are_side_by_side(learned, monkeypatch):
    parallel_ddim = pytest.importorskip("starjax.addons.decisions.parallel_ddim")
    params, _ = learned
    ten = tiny(ddim_steps=10)
    wanted, calls = repeats.sampled(ten, params), []
    one_by_one = diffusion.ddim_sample
    monkeypatch.setattr(diffusion, "ddim_sample", lambda *a, **k: calls.append(a))
    monkeypatch.setattr(parallel_ddim, "pays", lambda batch, steps: (batch, steps) == (2, 10))
    found = repeats.sampled(ten, params)
    np.testing.assert_allclose(found, wanted, atol=0.01)
    assert np.abs(found - wanted).max() > 0 and calls == []
    monkeypatch.setattr(diffusion, "ddim_sample", one_by_one)
    five = tiny(ddim_steps=5)
    monkeypatch.setattr(parallel_ddim, "ddim_sample", lambda *a, **k: calls.append(a))
    repeats.sampled(five, params)
    assert calls == []


@pytest.mark.slow
def test_at_temperature_zero_no_sample_depends_on_its_key(learned):
    params, _ = learned
    cold, warm = (tiny(ddim_steps=10, temperature=share) for share in (0.0, 1.0))
    np.testing.assert_array_equal(
        repeats.sampled(cold, params, 2), repeats.sampled(cold, params, 3)
    )
    assert np.abs(repeats.sampled(warm, params, 2) - repeats.sampled(warm, params, 3)).max() > 1e-4


def test_a_sample_starts_as_the_settings_say():
    """A network that predicts no noise leaves the sample's initial noise, scaled."""
    settings = tiny(diffusion_steps=50, ddim_steps=5, temperature=0.25)
    model = repeats.model(settings)
    shapes = jax.eval_shape(model.init, jax.random.key(0))
    params = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape), shapes)
    keys = jax.random.split(jax.random.key(2), 2)
    reach = 1e9 * jnp.array([[-1.0], [1.0]])
    found = jax.jit(model.sample)(params, keys, repeats.condition(repeats.PRESENT), reach)
    start = 0.25 * diffusion.sample_noise(keys, (settings.horizon, repeats.ACTION))
    first = schedule.ddim_table(50, 5).sqrt_alpha_bar[0]
    np.testing.assert_allclose(found, start / first, rtol=1e-4)
    k = model.prepare(jax.random.key(3), jnp.zeros((1024, 1))).k
    assert set(k.tolist()) == set(range(50))


def test_networks_are_as_the_options_say():
    def shapes(**changed):
        return jax.eval_shape(repeats.model(tiny(**changed)).init, jax.random.key(0))

    block = shapes(kernel_size=3)["unet"]["params"]["down_0_0"]["ConvBlock_0"]["Conv1d_0"]
    assert block["kernel"].shape[0] == 3
    with pytest.raises(ValueError, match=r"groups: expected a divisor of 16 channels, got 3"):
        shapes(groups=3)


@pytest.mark.parametrize(
    ("setting", "options", "shared"),
    [
        ("unet_channels", {"unet_channels": ()}, {}),
        ("unet_channels", {"unet_channels": (64, 100)}, {}),
        ("horizon", {"unet_channels": (16, 16, 16)}, {"horizon": 6}),
        ("ddim_steps", {"ddim_steps": 101}, {}),
    ],
)
def test_options_that_do_not_go_together_are_named(setting, options, shared):
    policy = dataclasses.replace(config.PolicyConfig(), **shared)
    changed = config.with_options(policy, **options)
    with pytest.raises(errors.UsageError) as caught:
        learner.check(changed.options, changed)
    assert caught.value.argument == f"policy.{setting}"
    learner.check(config.PolicyConfig().options, config.PolicyConfig())
