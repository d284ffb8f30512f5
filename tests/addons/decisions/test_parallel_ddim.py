"""Steps side by side end where steps one after the other do."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax.addons.decisions import parallel_ddim
from starjax.policies.models import diffusion, kernels, schedule

SCHEDULE = schedule.cosine(100)
NOISE = jnp.asarray(np.random.default_rng(0).normal(size=(2, 16, 4)), jnp.float32)


def at(table, k, x):
    """Entries k (`[]` or `[n]`) of a table, broadcast to `x` (`[B, H, A]` or `[n, B, H, A]`)."""
    return jnp.asarray(table)[k].reshape(-1, *(1,) * (x.ndim - 1))


def curved(x, k):
    """A network that is not linear in anything."""
    return (
        0.6 * jnp.sin(2.0 * x)
        + 0.1 * jnp.flip(x, -2)
        + 0.003 * at(np.arange(100, dtype=np.float32), k, x)
    )


def of_spread_data(spread, mean=0.3):
    """The noise that a perfect network sees in `x`, when clean entries are N(mean, spread^2)."""

    def eps_fn(x, k):
        signal, noise = (
            at(SCHEDULE.sqrt_alpha_bar, k, x),
            at(SCHEDULE.sqrt_one_minus_alpha_bar, k, x),
        )
        share = spread**2 * signal / (spread**2 * signal**2 + noise**2)
        return (x - signal * (mean + share * (x - signal * mean))) / noise

    return eps_fn


def of_two_ways(way=0.5, spread=0.1):
    """The noise that a perfect network sees, when a clean entry is near +way or near -way."""

    def eps_fn(x, k):
        signal, noise = (
            at(SCHEDULE.sqrt_alpha_bar, k, x),
            at(SCHEDULE.sqrt_one_minus_alpha_bar, k, x),
        )
        variance = (spread * signal) ** 2 + noise**2
        mean = way * jnp.tanh(way * signal * x / variance)
        clean = mean + spread**2 * signal / variance * (x - signal * mean)
        return (x - signal * clean) / noise

    return eps_fn


def apart(eps_fn, evaluations, reach=None, steps=10):
    wanted = diffusion.ddim_sample(eps_fn, NOISE, steps=steps, reach=reach)
    got = parallel_ddim.ddim_sample(
        eps_fn, NOISE, steps=steps, evaluations=evaluations, reach=reach
    )
    return float(jnp.abs(got - wanted).max())


@pytest.mark.parametrize("steps", [6, 10, 20])
def test_after_as_many_evaluations_as_steps_nothing_is_approximate(steps):
    assert apart(curved, steps, steps=steps) < 2e-5
    assert apart(curved, 2, steps=steps) > 1e-3


@pytest.mark.parametrize("spread", [0.0, 0.2])
def test_two_are_enough_where_the_clean_sequence_is_linear_in_the_noisy_one(spread):
    assert apart(of_spread_data(spread), 2) < 2e-5


def test_samples_stay_within_reach():
    reach = jnp.array([[-0.1] * 4, [0.1, 0.2, 0.3, 0.4]])
    sample = parallel_ddim.ddim_sample(curved, NOISE, reach=reach)
    assert (sample >= reach[0]).all() and (sample <= reach[1]).all()
    assert apart(curved, 10, reach) < 2e-5


def test_every_step_is_prepared_once():
    calls = []

    def prepare(k):
        calls.append(k.shape)
        return 2 * k

    halved = lambda x, twice: curved(x, twice // 2)  # noqa: E731
    got = parallel_ddim.ddim_sample(halved, NOISE, prepare=prepare)
    assert calls == [(10,)]
    np.testing.assert_array_equal(got, parallel_ddim.ddim_sample(curved, NOISE))


def test_a_sequence_does_not_depend_on_those_beside_it():
    alone = parallel_ddim.ddim_sample(curved, NOISE[1:])
    np.testing.assert_allclose(parallel_ddim.ddim_sample(curved, NOISE)[1:], alone, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(("steps", "evaluations"), [(6, 5), (10, 5), (11, 6), (50, 8), (100, 9)])
def test_more_steps_need_few_more_evaluations(steps, evaluations):
    assert parallel_ddim.evaluations_for(steps) == evaluations
    assert apart(of_two_ways(), None, steps=steps) < 1e-3
    assert apart(of_two_ways(), 2, steps=steps) > 1e-3


def test_it_pays_for_few_robots_on_a_gpu(monkeypatch):
    assert not parallel_ddim.pays(1, 10)
    monkeypatch.setattr(kernels, "on_gpu", lambda: True)
    most = {
        steps: max([0, *(batch for batch in range(1, 400) if parallel_ddim.pays(batch, steps))])
        for steps in (1, 5, 6, 10, 100)
    }
    assert most == {1: 0, 5: 0, 6: 5, 10: 15, 100: 14}


def test_noise_in_double_precision_changes_no_type():
    with jax.enable_x64(True):
        assert parallel_ddim.ddim_sample(curved, NOISE).dtype == jnp.float32
