"""A U-Net's blocks for sampling are the functions that were trained."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax.addons.decisions import sampling_unet
from starjax.policies.models import kernels, unet1d

GROUPS = 4


def inputs(*shape, seed=1):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


def made(module, *given):
    """Its parameters, none of them zero or one, and their output."""
    params = jax.jit(module.init)(jax.random.key(0), *given)["params"]
    leaves, tree = jax.tree.flatten(params)
    params = tree.unflatten([x + 0.3 * inputs(*x.shape, seed=i) for i, x in enumerate(leaves)])
    return params, jax.jit(module.apply)({"params": params}, *given)


def sample(module, params, *given):
    """What the block for sampling makes of a trained block's parameters."""
    of = {
        unet1d.ResidualBlock: sampling_unet.SamplingBlock,
        unet1d.ConvBlock: sampling_unet.SamplingConv,
    }[type(module)]
    block = of(module.features, module.kernel_size, module.groups)

    def apply(params, *given):
        return block.apply({"params": sampling_unet.prepared(params).params}, *given)

    return jax.jit(apply)(params, *given)


@pytest.mark.parametrize(
    ("kernel", "length", "channels"),
    [*((5, length, 8) for length in (16, 3, 2, 1)), (3, 2, 8), (1, 4, 8), (5, 16, 12), (5, 1, 12)],
)
def test_a_block_is_the_same_function(kernel, length, channels):
    """With a convolution parallel to the first one, from 8 channels to 12, and without."""
    module = unet1d.ResidualBlock(12, kernel, GROUPS)
    given = inputs(3, length, channels), inputs(3, 24, seed=2)
    params, expected = made(module, *given)
    assert ("Conv1d_0" in params) == (channels == 8)
    np.testing.assert_allclose(sample(module, params, *given), expected, atol=2e-5)


def test_the_last_convolution_is_the_same_function():
    module, x = unet1d.ConvBlock(12, 5, GROUPS), inputs(3, 16, 8)
    params, expected = made(module, x)
    np.testing.assert_allclose(sample(module, params, x), expected, atol=2e-5)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.bfloat16])
def test_a_whole_unet_takes_either_parameters(dtype):
    unet = unet1d.ConditionalUnet1D(
        action_dim=4, cond_dim=10, channels=(8, 16), groups=GROUPS, time_dim=16, dtype=dtype
    )
    given = inputs(3, 4, 4), jnp.arange(3) * 30, inputs(3, 10, seed=2)
    params = {"params": made(unet, *given)[0]}
    apply = jax.jit(kernels.applied(unet))
    prepared = sampling_unet.prepared(params)
    assert jax.tree.structure(prepared.params) != jax.tree.structure(params)
    expected, found = apply(params, *given), apply(prepared, *given)
    tolerance = 2e-5 if dtype == jnp.float32 else 0.05
    np.testing.assert_allclose(found, expected, atol=tolerance * float(jnp.abs(expected).max()))


def test_a_block_of_equal_numbers_is_finite():
    module = unet1d.ResidualBlock(8, 5, GROUPS)
    given = jnp.full((1, 4, 8), 5.0), jnp.ones((1, 16))
    params, _ = made(module, *given)
    zeros = jax.tree.map(jnp.zeros_like, params)  # its convolutions then give the same everywhere
    assert jnp.isfinite(sample(module, zeros, *given)).all()


def test_statistics_are_float32_where_numbers_are_bfloat16():
    """Both forms are as far from float32 as bfloat16's eight bits let them be."""
    module = unet1d.ResidualBlock(32, 5, GROUPS)
    given = inputs(3, 8, 32), inputs(3, 64, seed=2)
    params, exact = made(module, *given)
    narrow = [z.astype(jnp.bfloat16) for z in given]
    found = module.apply({"params": params}, *narrow), sample(module, params, *narrow)
    errors = [float(jnp.abs(y.astype(jnp.float32) - exact).mean()) for y in found]
    assert errors[1] < 1.2 * errors[0] < 0.05
