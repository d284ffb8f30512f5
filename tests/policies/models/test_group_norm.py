"""GroupNorm against its definition."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax.policies.models.group_norm import GroupNorm


def run(module, x, seed=0):
    y, variables = jax.jit(module.init_with_output)(jax.random.key(seed), x)
    return variables["params"], y


def inputs(*shape, seed=1):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


@pytest.mark.parametrize("shape", [(3, 5, 12), (3, 4, 5, 12)])
def test_group_norm_normalises_each_sample_and_group(shape):
    x = 3.0 * inputs(*shape) + 2.0
    _, y = run(GroupNorm(4), x)
    grouped = np.asarray(y, float).reshape(shape[0], -1, 4, 3)
    np.testing.assert_allclose(grouped.mean((1, 3)), 0.0, atol=1e-5)
    np.testing.assert_allclose(grouped.std((1, 3)), 1.0, atol=1e-4)


def test_group_norm_of_a_constant_is_finite_with_its_gradient():
    module, x = GroupNorm(2), jnp.full((2, 3, 4), 5.0)
    variables = module.init(jax.random.key(0), x)
    weigh = lambda x: (module.apply(variables, x) * inputs(2, 3, 4)).sum()  # noqa: E731
    y, gradient = jax.jit(jax.value_and_grad(weigh))(x)
    assert jnp.isfinite(y)
    assert jnp.isfinite(gradient).all()


def test_groups_must_divide_the_channels():
    with pytest.raises(ValueError, match="groups: expected a divisor of 6 channels, got 4"):
        GroupNorm(4).init(jax.random.key(0), jnp.ones((1, 2, 6)))


def test_its_epsilon_is_torchs():
    x = jnp.array([[[-3e-3, 3e-3]]])  # variance 9e-6
    _, y = run(GroupNorm(1), x)
    np.testing.assert_allclose(y[0, 0, 1], 3e-3 / np.sqrt(9e-6 + 1e-5), rtol=1e-4)
