"""Layers against jax's own convolutions and closed forms."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax.policies.models import layers


def run(module, x, seed=0):
    y, variables = jax.jit(module.init_with_output)(jax.random.key(seed), x)
    return variables["params"], y


def inputs(*shape, seed=1):
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


def reference_conv(x, kernel, bias, stride, padding):
    dimensions = ("NWC", "WIO", "NWC")
    y = jax.lax.conv_general_dilated(
        x, kernel, (stride,), [(padding, padding)], dimension_numbers=dimensions
    )
    return y + bias


@pytest.mark.parametrize(
    ("kernel", "stride", "length"), [(5, 1, 16), (3, 2, 16), (1, 1, 4), (5, 1, 3)]
)
def test_conv_is_jaxs_convolution(kernel, stride, length):
    x = inputs(2, length, 6)
    params, y = run(layers.Conv1d(4, kernel, stride=stride), x)
    assert params["kernel"].shape[0] == kernel  # nothing is dropped at these lengths
    expected = reference_conv(x, params["kernel"], params["bias"], stride, kernel // 2)
    np.testing.assert_allclose(y, expected, atol=1e-5)


@pytest.mark.parametrize(
    ("kernel", "stride", "length", "live"),
    [
        (5, 1, 2, slice(1, 4)),
        (5, 1, 1, slice(2, 3)),
        (3, 2, 2, slice(1, 3)),
        (7, 1, 3, slice(1, 6)),
    ],
)
def test_dropped_taps_change_nothing(kernel, stride, length, live):
    """The full kernel gives the same function for any dead taps."""
    x = inputs(2, length, 6)
    params, y = run(layers.Conv1d(4, kernel, stride=stride), x)
    assert params["kernel"].shape[0] == live.stop - live.start
    full = 100.0 * inputs(kernel, 6, 4, seed=2).at[live].set(0.0)
    full = full.at[live].set(params["kernel"])
    expected = reference_conv(x, full, params["bias"], stride, kernel // 2)
    np.testing.assert_allclose(y, expected, atol=1e-5)


def test_upsample_is_the_transpose_of_a_strided_convolution():
    """<up(x), y> = <x, down(y)> for the convolution of kernel 4, stride 2, padding 1."""
    x, y = inputs(2, 4, 3), inputs(2, 8, 3, seed=2)
    params, up = run(layers.Upsample1d(), x)
    up = up - params["bias"]
    (w1, w3), (w2, w0) = params["kernel"].reshape(2, 2, 3, 3)
    down = reference_conv(y, jnp.stack([w0, w1, w2, w3]).transpose(0, 2, 1), 0.0, 2, 1)
    assert float((up * y).sum()) == pytest.approx(float((x * down).sum()), rel=1e-4)


def test_mish_is_its_definition_and_never_overflows():
    x = jnp.concatenate([jnp.linspace(-30, 30, 601), jnp.array([-1e30, 1e30])])
    wide = np.asarray(x, float)
    with np.errstate(over="ignore"):
        expected = wide * np.tanh(np.logaddexp(0.0, wide))
    np.testing.assert_allclose(layers.mish(x), expected, rtol=1e-5, atol=1e-9)
    assert jnp.isfinite(jax.vmap(jax.grad(layers.mish))(x)).all()


def test_initial_values_are_uniform_and_of_their_own_key():
    draw = layers.uniform_init(16)
    x = np.asarray(draw(jax.random.key(3), (400, 500)), float) * 4.0
    counts, _ = np.histogram(x, 20, (-1.0, 1.0))
    assert counts.sum() == x.size
    assert (np.abs(counts - 10_000) < 500).all()
    other = np.asarray(draw(jax.random.fold_in(jax.random.key(3), 1), (400, 500)), float) * 4.0
    for a, b in ((x, other), (x[1:], x[:-1]), (x[:, 1:], x[:, :-1])):
        assert abs((a * b).mean()) < 0.003  # the deviation of such a mean is 0.0008


@pytest.mark.parametrize("shape", [(6, 3, 5), (256, 16, 8), (12, 8)])
def test_a_spread_vectors_gradient_is_summed_in_float32(shape):
    g = inputs(*shape).astype(jnp.bfloat16)
    vector = jnp.arange(shape[-1], dtype=jnp.bfloat16)
    y, gradient = jax.vjp(lambda v: layers.spread(v, shape), vector)
    np.testing.assert_array_equal(y, np.broadcast_to(vector, shape))
    exact = np.asarray(g, np.float64).reshape(-1, shape[-1]).sum(0)
    np.testing.assert_allclose(gradient(g)[0].astype(float), exact, rtol=0.01, atol=0.01)


def test_a_convolution_starts_within_torchs_bound():
    """1 / sqrt(taps times channels), also of the bias and where taps are dropped."""
    for length in (16, 2):
        params, _ = run(layers.Conv1d(64, 5), inputs(2, length, 16))
        for leaf in jax.tree.leaves(params):
            assert 0.9 < float(jnp.abs(leaf).max()) * np.sqrt(5 * 16) <= 1.0
