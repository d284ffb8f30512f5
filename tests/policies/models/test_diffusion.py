"""Noising and denoising: statistics, a perfect oracle, and independence from the batch."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax.policies.models import diffusion, schedule

SCHEDULE = schedule.cosine(100)


def perfect(x0):
    """The noise that a perfect network would see in `x`, when the data is the single point x0."""

    def eps_fn(x, k):
        signal = jnp.asarray(SCHEDULE.sqrt_alpha_bar)[k]
        return (x - signal * x0) / jnp.asarray(SCHEDULE.sqrt_one_minus_alpha_bar)[k]

    return eps_fn


def clean(shape):
    values = np.random.default_rng(1).uniform(-1.0, 1.0, shape)
    return jnp.asarray(values, jnp.float32)


def normal(*shape, seed=2):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


@pytest.mark.parametrize("k", [0, 37, 99])
def test_noised_samples_have_the_mean_and_deviation_of_eq_7(k):
    noise = normal(20_000, 1)
    x = diffusion.add_noise(SCHEDULE, jnp.full((20_000, 1), 0.7), jnp.full(20_000, k), noise)
    signal = float(SCHEDULE.sqrt_alpha_bar[k])
    spread = float(SCHEDULE.sqrt_one_minus_alpha_bar[k])
    assert float(x.mean()) == pytest.approx(0.7 * signal, abs=4 * spread / 141)
    assert float(x.std()) == pytest.approx(spread, rel=0.02)


def test_add_noise_takes_each_samples_own_step():
    x0, noise, k = clean((3, 4, 2)), jnp.ones((3, 4, 2)), jnp.array([0, 50, 99])
    together = diffusion.add_noise(SCHEDULE, x0, k, noise)
    for i in range(3):
        alone = diffusion.add_noise(SCHEDULE, x0[i], k[i], noise[i])
        np.testing.assert_allclose(together[i], alone, rtol=1e-6)


@pytest.mark.parametrize("steps", [1, 2, 10, 100])
def test_ddim_with_a_perfect_network_returns_the_clean_sequence(steps):
    x0 = clean((2, 16, 4))
    noise = normal(2, 16, 4)
    x = diffusion.ddim_sample(perfect(x0), noise, steps=steps)
    np.testing.assert_allclose(x, x0, atol=1e-5)


def test_ddim_step_is_the_papers_formula():
    """Two steps of Song et al. (12) with sigma = 0, in float64, for an imperfect network."""
    noise = normal(1, 8, 2)
    eps_fn = lambda x, k: 0.4 * jnp.sin(3.0 * x) + 0.001 * k  # noqa: E731
    x = np.asarray(noise, float)
    for k, after in ((50, 0), (0, None)):
        alpha = float(SCHEDULE.sqrt_alpha_bar[k]) ** 2
        following = 1.0 if after is None else float(SCHEDULE.sqrt_alpha_bar[after]) ** 2
        eps = 0.4 * np.sin(3.0 * x) + 0.001 * k
        x0 = np.clip((x - np.sqrt(1 - alpha) * eps) / np.sqrt(alpha), -1, 1)
        x = np.sqrt(following) * x0 + np.sqrt(1 - following) * eps
    np.testing.assert_allclose(diffusion.ddim_sample(eps_fn, noise, steps=2), x, atol=3e-6)


def test_ddim_reaches_as_far_as_it_may():
    x0 = jnp.broadcast_to(jnp.array([-3.0, -1.2, 1.2, 3.0]), (2, 16, 4))
    found = diffusion.ddim_sample(perfect(x0), normal(2, 16, 4), steps=10)
    np.testing.assert_allclose(found[0, 0], [-1, -1, 1, 1], atol=1e-6)
    reach = jnp.array([[-1.5] * 4, [1.0, 1.0, 1.5, 2.0]])
    found = diffusion.ddim_sample(perfect(x0), normal(2, 16, 4), steps=10, reach=reach)
    np.testing.assert_allclose(found[0, 0], [-1.5, -1.2, 1.2, 2.0], atol=1e-5)


def test_ddim_prepares_every_step_once():
    calls = []

    def prepare(k):
        calls.append(k.shape)
        return {"double": 2 * k}

    noise = jnp.ones((1, 4, 2))
    eps_fn = lambda x, k: 0.01 * k * x  # noqa: E731
    prepared = diffusion.ddim_sample(
        lambda x, at_k: eps_fn(x, at_k["double"] // 2), noise, steps=5, prepare=prepare
    )
    assert calls == [(5,)]
    np.testing.assert_allclose(prepared, diffusion.ddim_sample(eps_fn, noise, steps=5), rtol=1e-6)


def test_noise_of_a_sample_depends_on_its_key_alone():
    keys = jax.random.split(jax.random.key(7), 5)
    full = diffusion.sample_noise(keys, (16, 4))
    np.testing.assert_array_equal(full[2:3], diffusion.sample_noise(keys[2:3], (16, 4)))
    with jax.enable_x64(True):  # where jax draws other numbers
        np.testing.assert_array_equal(full, diffusion.sample_noise(keys, (16, 4)))
    assert not np.array_equal(full[0], full[1])


def test_loss_is_zero_for_the_right_noise_and_one_for_none():
    x0 = clean((512, 4, 2))
    given = diffusion.noised(SCHEDULE, jax.random.key(8), x0)
    loss = lambda eps_fn: diffusion.eps_loss(eps_fn, given)  # noqa: E731
    assert float(loss(lambda x, k: jax.vmap(lambda x, x0, k: perfect(x0)(x, k))(x, x0, k))) < 1e-3
    assert float(loss(lambda x, k: jnp.zeros_like(x))) == pytest.approx(1.0, abs=0.07)


def test_loss_draws_every_step():
    given = diffusion.noised(SCHEDULE, jax.random.key(9), clean((4096, 1)))
    assert set(given.k.tolist()) == set(range(100))
