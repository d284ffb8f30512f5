"""The conditional U-Net: size against the published one, exact FiLM split, reach, precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax.models import diffusion, unet1d

KEY = jax.random.key(0)


def make(**changes):
    settings = {
        "action_dim": 4,
        "cond_dim": 10,
        "channels": (8, 16, 16),
        "groups": 4,
        "time_dim": 16,
    }
    return unet1d.ConditionalUnet1D(**{**settings, **changes})


def data(batch=3, horizon=16):
    x = jax.random.normal(jax.random.key(1), (batch, horizon, 4))
    cond = jax.random.normal(jax.random.key(2), (batch, 10))
    return x, jnp.arange(batch) * 30, cond


@pytest.fixture(scope="module")
def small():
    module = make()
    return module, jax.jit(module.init)(KEY, *data())


def published_size(channels, kernel, action, cond, time):
    """Parameters of Diffusion Policy's ConditionalUnet1D, counted from its code."""
    conv = lambda cin, cout, k: k * cin * cout + cout  # noqa: E731

    def block(cin, cout):
        film = (time + cond) * 2 * cout + 2 * cout
        skip = conv(cin, cout, 1) if cin != cout else 0
        return conv(cin, cout, kernel) + conv(cout, cout, kernel) + 4 * cout + film + skip

    total = conv(time, 4 * time, 1) + conv(4 * time, time, 1)
    pairs = list(zip((action, *channels[:-1]), channels))
    for i, (cin, cout) in enumerate(pairs):
        total += block(cin, cout) + block(cout, cout)
        total += conv(cout, cout, 3) if i < len(pairs) - 1 else 0
    total += 2 * block(channels[-1], channels[-1])
    for cin, cout in reversed(pairs[1:]):
        total += block(2 * cout, cin) + block(cin, cin) + conv(cin, cin, 4)
    return (
        total
        + conv(channels[0], channels[0], kernel)
        + 2 * channels[0]
        + conv(channels[0], action, 1)
    )


def test_size_is_the_published_one_less_the_dead_taps():
    module = unet1d.ConditionalUnet1D(action_dim=4, cond_dim=2 * 512 + 256)
    shapes = jax.eval_shape(
        module.init, KEY, jnp.zeros((1, 16, 4)), jnp.zeros((1,), int), jnp.zeros((1, 1280))
    )
    size = sum(leaf.size for leaf in jax.tree.leaves(shapes))
    published = published_size((256, 512, 1024, 2048), 5, 4, 1280, 128)
    # At length 2 two of five taps are dead: four blocks of 2048 in the way down and the middle,
    # two of 1024 at the start of the way up.
    products = 1024 * 2048 + 7 * 2048 * 2048 + 4096 * 1024 + 3 * 1024 * 1024
    assert published == pytest.approx(291.1e6, rel=1e-3)
    assert size == published - 2 * products
    assert 2 * products == pytest.approx(77.6e6, rel=1e-3)


def test_every_parameter_gets_a_gradient(small):
    """With dead taps some would be exactly zero."""
    module, params = small
    x, k, cond = data()
    gradient = jax.grad(lambda p: (module.apply(p, x, k, cond) ** 2).mean())(params)
    for path, leaf in jax.tree_util.tree_leaves_with_path(gradient):
        flat = leaf if leaf.ndim < 3 else jnp.abs(leaf).sum((1, 2))
        assert jnp.isfinite(leaf).all(), path
        assert (jnp.abs(flat) > 0).any() if leaf.ndim < 3 else (flat > 0).all(), path


def test_film_split_is_exact(small):
    """The sum of both parts is the affine map of Mish(concatenation), as published."""
    module, params = small
    _, k, cond = data()
    inner = params["params"]
    kernel = jnp.concatenate([inner["film_time"], inner["film_cond"]])
    frequency = 10_000.0 ** (-np.arange(8) / 7)
    angle = np.asarray(k)[:, None] * frequency
    wave = jnp.asarray(np.concatenate([np.sin(angle), np.cos(angle)], -1), jnp.float32)
    mish = lambda x: x * jnp.tanh(jax.nn.softplus(x))  # noqa: E731
    h = mish(wave @ inner["time_in"]["kernel"] + inner["time_in"]["bias"])
    embedding = h @ inner["time_out"]["kernel"] + inner["time_out"]["bias"]
    expected = mish(jnp.concatenate([embedding, cond], -1)) @ kernel + inner["film_bias"]
    split = module.apply(params, cond, method="condition") + module.apply(
        params, k, method="embed_step"
    )
    np.testing.assert_allclose(split, expected, atol=1e-5)


def test_sampling_with_the_condition_computed_once(small):
    module, params = small
    _, _, cond = data()
    noise = diffusion.sample_noise(jax.random.split(KEY, 3), (16, 4))

    @jax.jit
    def once(cond):
        film = module.apply(params, cond, method="condition")
        return diffusion.ddim_sample(
            lambda x, at_k: module.apply(params, x, film + at_k, method="denoise"),
            noise,
            steps=4,
            prepare=lambda k: module.apply(params, k, method="embed_step"),
        )

    @jax.jit
    def each_time(cond):
        return diffusion.ddim_sample(lambda x, k: module.apply(params, x, k, cond), noise, steps=4)

    np.testing.assert_allclose(once(cond), each_time(cond), atol=1e-4)


def test_samples_do_not_see_each_other(small):
    module, params = small
    x, k, cond = data()
    together = module.apply(params, x, k, cond)
    changed = module.apply(params, x.at[1].set(9.0), k, cond.at[1].set(-9.0))
    np.testing.assert_array_equal(together[0], changed[0])
    alone = module.apply(params, x[:1], k[:1], cond[:1])
    np.testing.assert_allclose(together[:1], alone, atol=1e-5)


def test_the_last_step_sees_the_first_and_the_condition(small):
    module, params = small
    x, k, cond = data(batch=1)
    output = lambda x, k, cond: module.apply(params, x, k, cond)[0, -1].sum()  # noqa: E731
    gradient_x, gradient_cond = jax.grad(output, (0, 2))(x, k, cond)
    assert float(jnp.abs(gradient_x[0, 0]).max()) > 0
    assert float(jnp.abs(gradient_cond).max()) > 0
    assert output(x, k, cond) != output(x, k + 1, cond)


def test_bfloat16_is_close_and_keeps_float32_parameters(small):
    module, params = small
    x, k, cond = data()
    exact = module.apply(params, x, k, cond)
    half = make(dtype=jnp.bfloat16)
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(half.init(KEY, x, k, cond)))
    rough = half.apply(params, x, k, cond)
    assert rough.dtype == jnp.float32
    error = float(jnp.sqrt(((rough - exact) ** 2).mean() / (exact**2).mean()))
    assert 1e-5 < error < 0.05


def test_wrong_shapes_are_named(small):
    module, params = small
    x, k, cond = data()
    with pytest.raises(ValueError, match=r"x: expected \[B, H, 4\] with H divisible by 4, got"):
        module.apply(params, x[:, :15], k, cond)
    with pytest.raises(ValueError, match=r"cond: expected \[B, 10\], got \(3, 9\)"):
        module.apply(params, x, k, cond[:, :9])
