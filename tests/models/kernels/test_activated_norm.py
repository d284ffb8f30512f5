"""Bias, GroupNorm and Mish with one gradient: it is the one that jax finds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax.models import layers
from starjax.models.kernels import activated_norm, norms

GROUPS = 4


def inputs(*shape, seed=1):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


def given(length, dtype=jnp.float32):
    """Product, bias, scale and shift, and a gradient of what comes out."""
    vectors = (2.0 * inputs(24, seed=seed) for seed in (2, 3, 4))
    product, g = 3.0 * inputs(5, length, 24) + 1.0, inputs(5, length, 24, seed=5)
    return (product.astype(dtype), *vectors), g.astype(dtype)


@pytest.mark.parametrize("length", [16, 2, 1])
def test_both_gradients_are_of_the_three_layers(length):
    args, g = given(length)

    def plain(product, bias, scale, shift):
        return layers.mish(norms.group_norm(product + bias, scale, shift, GROUPS))

    expected, back = jax.vjp(plain, *args)
    y, kept = activated_norm.forward(*args, GROUPS)
    np.testing.assert_allclose(y, expected, atol=1e-5)
    for gradient in (activated_norm.at_once, activated_norm.one_by_one):
        for one, other in zip(gradient(GROUPS, kept, g), back(g), strict=True):
            assert float(jnp.abs(other).max()) > 0.1 or length == 1
            np.testing.assert_allclose(one, other, atol=2e-5, rtol=2e-5)


def test_in_bfloat16_it_is_as_near_as_its_bits():
    args, g = given(8)
    exact = activated_norm.at_once(GROUPS, activated_norm.forward(*args, GROUPS)[1], g)
    args, g = given(8, jnp.bfloat16)
    found = activated_norm.at_once(GROUPS, activated_norm.forward(*args, GROUPS)[1], g)
    assert [x.dtype for x in found] == [jnp.bfloat16, *3 * [jnp.float32]]
    for one, other in zip(found, exact, strict=True):
        error = jnp.abs(one.astype(jnp.float32) - other).mean() / jnp.abs(other).mean()
        assert float(error) < 0.02


def test_equal_and_large_numbers_have_finite_gradients():
    (product, *vectors), g = given(8)
    for x in (jnp.full_like(product, 5.0), 1e6 * product):
        _, kept = activated_norm.forward(x, *vectors, GROUPS)
        assert all(jnp.isfinite(z).all() for z in activated_norm.at_once(GROUPS, kept, g))


def test_a_gradient_that_is_not_finite_stays_so():
    """Or a step would be taken that should be left out."""
    args, g = given(8)
    _, kept = activated_norm.forward(*args, GROUPS)
    found = activated_norm.at_once(GROUPS, kept, g.at[2, 3, 4].set(jnp.nan))
    assert not any(jnp.isfinite(z).all() for z in found)
