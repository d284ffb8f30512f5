"""Advantages by hand."""

import jax.numpy as jnp
import numpy as np

from starjax.addons.finetune import advantages

G, L = advantages.DISCOUNT, advantages.DISCOUNT * advantages.TRACE


def test_three_decisions_by_hand():
    value = jnp.array([[0.5, 0.6, 0.7], [0.4, 0.3, 9.0], [0.2, 0.1, 0.3]])
    reward = jnp.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    alive = jnp.array([[1, 1, 1], [1, 1, 0], [1, 1, 1]], bool)
    found = advantages.estimate(reward, value, alive)
    won = [G * 0.6 - 0.5, G * 0.7 - 0.6, 1 - 0.7]
    short = [G * 0.3 - 0.4, 1 - 0.3]
    late = [G * 0.1 - 0.2, G * 0.3 - 0.1, -0.3]  # the limit is worth nothing
    want = [
        [won[0] + L * (won[1] + L * won[2]), won[1] + L * won[2], won[2]],
        [short[0] + L * short[1], short[1], 0.0],
        [late[0] + L * (late[1] + L * late[2]), late[1] + L * late[2], late[2]],
    ]
    np.testing.assert_allclose(found.advantage, want, atol=1e-6)
    want_returns = np.array(want) + np.where(alive, value, 0.0)
    np.testing.assert_allclose(found.returns, want_returns, atol=1e-6)


def test_standardised_advantages_ignore_what_is_over():
    alive = jnp.array([[1, 1], [1, 0]], bool)
    found = advantages.standardised(jnp.array([[1.0, 2.0], [6.0, 100.0]]), alive)
    kept = np.asarray(found)[np.asarray(alive)]
    np.testing.assert_allclose([kept.mean(), kept.std(), found[1, 1]], [0, 1, 0], atol=1e-6)
