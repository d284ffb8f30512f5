"""Sums in two steps are the sums over all positions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax.policies.models import kernels, layers
from starjax.policies.models.kernels import channel_sums


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.bfloat16])
@pytest.mark.parametrize("shape", [(6, 3, 5), (256, 16, 8), (12, 8)])
def test_it_is_the_sum_over_all_positions(shape, dtype):
    g = jnp.asarray(np.random.default_rng(1).normal(size=shape), dtype)
    found = channel_sums.in_two_steps(g)
    exact = np.asarray(g, np.float64).reshape(-1, shape[-1]).sum(0)
    tolerance = 1e-4 if dtype == jnp.float32 else 0.01
    assert found.dtype == dtype
    np.testing.assert_allclose(found.astype(float), exact, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("on_gpu", [False, True])
def test_a_gpu_uses_it_for_the_gradients_of_biases(on_gpu, monkeypatch):
    monkeypatch.setattr(kernels, "on_gpu", lambda: on_gpu)
    layers.spread.clear_cache()
    _, gradient = jax.vjp(lambda v: layers.spread(v, (256, 16, 8)), jnp.zeros(8))
    text = str(jax.make_jaxpr(gradient)(jnp.zeros((256, 16, 8))))
    layers.spread.clear_cache()
    assert text.count("reduce_sum") == (2 if on_gpu else 1)
