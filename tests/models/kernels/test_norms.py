"""GroupNorm against its definition, and its gradient at once against the one that jax finds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax.models import layers
from starjax.models.kernels import norms

GROUPS = 4


def run(module, x, seed=0):
    y, variables = jax.jit(module.init_with_output)(jax.random.key(seed), x)
    return variables["params"], y


def inputs(*shape, seed=1):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


@pytest.fixture
def as_on_a_gpu(monkeypatch):
    """Programs are traced as for a GPU, and run here."""
    monkeypatch.setattr(layers, "on_gpu", lambda: True)
    norms.group_norm.clear_cache()
    yield
    norms.group_norm.clear_cache()


@pytest.mark.parametrize("shape", [(3, 5, 12), (3, 4, 5, 12)])
def test_group_norm_normalises_each_sample_and_group(shape):
    x = 3.0 * inputs(*shape) + 2.0
    _, y = run(norms.GroupNorm(4), x)
    grouped = np.asarray(y, float).reshape(shape[0], -1, 4, 3)
    np.testing.assert_allclose(grouped.mean((1, 3)), 0.0, atol=1e-5)
    np.testing.assert_allclose(grouped.std((1, 3)), 1.0, atol=1e-4)


def test_group_norm_of_a_constant_is_finite_with_its_gradient():
    module, x = norms.GroupNorm(2), jnp.full((2, 3, 4), 5.0)
    variables = module.init(jax.random.key(0), x)
    weigh = lambda x: (module.apply(variables, x) * inputs(2, 3, 4)).sum()  # noqa: E731
    y, gradient = jax.jit(jax.value_and_grad(weigh))(x)
    assert jnp.isfinite(y)
    assert jnp.isfinite(gradient).all()


def test_groups_must_divide_the_channels():
    with pytest.raises(ValueError, match="groups: expected a divisor of 6 channels, got 4"):
        norms.GroupNorm(4).init(jax.random.key(0), jnp.ones((1, 2, 6)))


def test_its_epsilon_is_torchs():
    x = jnp.array([[[-3e-3, 3e-3]]])  # variance 9e-6
    _, y = run(norms.GroupNorm(1), x)
    np.testing.assert_allclose(y[0, 0, 1], 3e-3 / np.sqrt(9e-6 + 1e-5), rtol=1e-4)


@pytest.mark.parametrize("shape", [(3, 3), (7, 7), (6, 8), (12, 12), (9, 14), (15, 15), (20,)])
def test_its_gradient_at_once_is_the_one_that_jax_finds(shape, as_on_a_gpu):
    x, g = 3.0 * inputs(2, *shape, 12) + 1.0, inputs(2, *shape, 12, seed=2)
    vectors = 2.0 * inputs(12, seed=3), inputs(12, seed=4)

    def plain(x, scale, shift):
        positions = tuple(range(1, x.ndim - 1))
        moments = (x.mean(positions), (x * x).mean(positions))
        return norms.normalized(x, *norms.affine(*moments, scale, shift, GROUPS))

    expected, back = jax.vjp(plain, x, *vectors)
    y, ours = jax.vjp(lambda *args: norms.group_norm(*args, GROUPS), x, *vectors)
    np.testing.assert_allclose(y, expected, atol=1e-5)
    for one, other in zip(ours(g), back(g), strict=True):
        assert float(jnp.abs(other).max()) > 0.1
        np.testing.assert_allclose(one, other, atol=2e-5, rtol=2e-5)


def test_a_gpu_adds_up_small_images_without_a_reduction():
    """Of 7x7 none is left, of 14x14 the sum over rows, of more all of it."""
    found = {}
    for side in (7, 14, 15):
        traced = jax.make_jaxpr(norms.sums)(jnp.zeros((1, side, side, 4)))
        found[side] = [e.params["axes"] for e in traced.eqns if e.primitive.name == "reduce_sum"]
    assert found == {7: [], 14: [(1,)], 15: [(1, 2)]}


@pytest.mark.parametrize("shape", [(7, 7), (3, 14), (14, 14), (15, 15), (16,)])
def test_its_sums_are_sums(shape):
    x, y = inputs(2, *shape, 4), inputs(2, *shape, 4, seed=2)
    for one, other in zip(norms.sums(x, y), (x, y), strict=True):
        np.testing.assert_allclose(one, other.reshape(2, -1, 4).sum(1), atol=1e-4)
