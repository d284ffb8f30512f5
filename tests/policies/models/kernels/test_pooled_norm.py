"""A ResNet's stem against a plain convolution, GroupNorm, ReLU and max-pooling."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax.policies.models import resnet
from starjax.policies.models.group_norm import GroupNorm
from starjax.policies.models.kernels import pooled_norm

KEY = jax.random.key(0)


def normal(*shape):
    return jnp.asarray(np.random.default_rng(1).normal(size=shape), jnp.float32)


@pytest.fixture(scope="module", params=[(16, 20), (15, 18), (13, 9)])
def stem(request):
    """Our convolution, GroupNorm, ReLU and max-pooling, and jax's: outputs and gradients."""
    x, size = normal(3, *request.param, 3), tuple(-(-side // 2) for side in request.param)
    ours, norm = resnet.Stem(32), pooled_norm.PooledNorm(2, size)
    plain, plain_norm = resnet.Conv2d(32, 7, 2), GroupNorm(2)
    reference = resnet.NormReluPool(2, size)
    params = plain.init(KEY, x), plain_norm.init(KEY, normal(3, *size, 32))
    # half of the gains negative, where the largest comes from the smallest
    params = jax.tree.map(lambda leaf: leaf * normal(*leaf.shape), params)

    def actual(params, x):
        return norm.apply(params[1], ours.apply(params[0], x))

    def expected(params, x):
        y = jax.nn.relu(plain_norm.apply(params[1], plain.apply(params[0], x)))
        pads = [(0, 0), (1, 1), (1, 1), (0, 0)]
        return jax.lax.reduce_window(y, -jnp.inf, jax.lax.max, (1, 3, 3, 1), (1, 2, 2, 1), pads)

    def outputs(start):
        y, pullback = jax.vjp(start, params, x)
        return y, pullback(normal(*y.shape))

    def without_variant(params, x):
        return reference.apply(params[1], ours.apply(params[0], x))

    return [outputs(jax.jit(start)) for start in (actual, expected, without_variant)]


def test_the_stem_is_what_it_stands_for(stem):
    (actual, _), (expected, _), (reference, _) = stem
    assert actual.shape == expected.shape
    assert (expected == 0).any()
    tolerance = 1e-5 * float(jnp.abs(expected).max())
    np.testing.assert_allclose(actual, expected, atol=tolerance)
    np.testing.assert_allclose(reference, expected, atol=tolerance)


def test_the_stems_gradient_is_too(stem):
    (_, *ours), (_, expected), (_, reference) = stem
    for actual in (*ours, reference):
        close(actual, expected)


def close(actual, expected):
    for ours, jaxs in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(ours, jaxs, atol=1e-5 * float(jnp.abs(jaxs).max()))
