"""Convolutions as matrix products against jax's convolutions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax.addons.decisions import few_images
from starjax.policies.models import kernels, resnet


def normal(*shape):
    return jnp.asarray(np.random.default_rng(1).normal(size=shape), jnp.float32)


@pytest.mark.parametrize("size", [(7, 9), (8, 6)])
@pytest.mark.parametrize(("kernel", "stride", "pad"), [(3, 1, 1), (3, 2, 1), (1, 2, 0), (4, 1, 0)])
def test_a_convolution_as_a_product_is_the_same(size, kernel, stride, pad):
    x, w = normal(2, *size, 5), normal(kernel, kernel, 5, 3)
    actual = few_images.convolution(x, w, stride, pad)
    np.testing.assert_allclose(actual, resnet.convolve(x, w, stride, pad), atol=1e-4)


def test_a_strided_slice_is_kept_out_of_a_products_kernel():
    # XLA's compiler for GPUs aborts on it, which no test without a GPU would see
    program = jax.jit(lambda x, w: few_images.convolution(x, w, 2, 0))
    text = program.lower(normal(2, 29, 29, 8), normal(1, 1, 8, 16)).as_text()
    assert "optimization_barrier" in text


def test_it_pays_for_two_images_on_a_gpu(monkeypatch):
    assert not few_images.pays(1)
    monkeypatch.setattr(kernels, "on_gpu", lambda: True)
    assert [few_images.pays(count) for count in (1, 2, 3)] == [True, True, False]
