"""The conditional U-Net: size against the published one, exact FiLM split, reach, precision."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax.policies.models import diffusion, layers, unet1d

KEY = jax.random.key(0)


def make(**changes):
    settings = {"action_dim": 4, "cond_dim": 10, "channels": (8, 16), "groups": 4, "time_dim": 16}
    return unet1d.ConditionalUnet1D(**{**settings, **changes})


def data():
    """Three samples; at the lower level the length is 2, where two taps of five are dead."""
    rng = np.random.default_rng(1)
    x, cond = (jnp.asarray(rng.normal(size=s), jnp.float32) for s in ((3, 4, 4), (3, 10)))
    return x, jnp.arange(3) * 30, cond


@pytest.fixture(scope="module")
def params():
    return jax.jit(make().init)(KEY, *data())


@pytest.fixture(scope="module")
def apply():
    """One compiled program for all tests."""
    return jax.jit(make().apply)


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


@pytest.fixture(scope="module")
def gradients(params):
    """Derivatives of the last output, by parameters, sequence and condition of the first sample."""
    x, k, cond = data()
    output = lambda p, x, c: make().apply(p, x, k, c)[0, -1].sum()  # noqa: E731
    return jax.jit(jax.grad(output, (0, 1, 2)))(params, x, cond)


@pytest.mark.slow
def test_every_parameter_gets_a_gradient(gradients):
    """Tap by tap: a dead one would get exactly zero."""
    for path, leaf in jax.tree_util.tree_leaves_with_path(gradients[0]):
        assert jnp.isfinite(leaf).all(), path
        taps = leaf.reshape(len(leaf), -1) if leaf.ndim == 3 else leaf.reshape(1, -1)
        assert (jnp.abs(taps).max(1) > 0).all(), path


@pytest.mark.slow
def test_the_last_step_sees_the_first_and_the_condition_but_no_other_sample(gradients):
    for gradient in gradients[1:]:
        assert (jnp.abs(gradient[0]).max(-1) > 0).all()
        np.testing.assert_array_equal(gradient[1:], 0.0)


def test_the_diffusion_step_matters(params, apply):
    x, k, cond = data()
    assert (apply(params, x, k, cond) != apply(params, x, k + 1, cond)).any((1, 2)).all()


def test_samples_do_not_see_each_other(params, apply):
    x, k, cond = data()
    together = apply(params, x, k, cond)
    changed = apply(params, x.at[1].set(9.0), k, cond.at[1].set(-9.0))
    np.testing.assert_array_equal(together[::2], changed[::2])
    assert not np.array_equal(together[1], changed[1])


def test_film_split_is_exact(params):
    """The sum of both parts is the affine map of Mish(concatenation), as published."""
    _, k, cond = data()
    inner = jax.tree.map(lambda leaf: np.asarray(leaf, float), params["params"])
    mish = lambda x: x * np.tanh(np.logaddexp(0.0, x))  # noqa: E731
    angle = np.asarray(k)[:, None] * 10_000.0 ** (-np.arange(8) / 7)
    wave = np.concatenate([np.sin(angle), np.cos(angle)], -1)
    h = mish(wave @ inner["time_in"]["kernel"] + inner["time_in"]["bias"])
    embedding = h @ inner["time_out"]["kernel"] + inner["time_out"]["bias"]
    kernel = np.concatenate([inner["film_time"], inner["film_cond"]])
    expected = mish(np.concatenate([embedding, cond], -1)) @ kernel + inner["film_bias"]

    @jax.jit
    def split(params):
        of_cond = make().apply(params, cond, method="condition")
        return of_cond + make().apply(params, k, method="embed_step")

    np.testing.assert_allclose(split(params), expected, atol=1e-5)


@pytest.mark.slow
def test_sampling_with_the_condition_computed_once(params, apply):
    noise, _, cond = data()

    @jax.jit
    def once(cond):
        film = make().apply(params, cond, method="condition")
        return diffusion.ddim_sample(
            lambda x, at_k: make().apply(params, x, film + at_k, method="denoise"),
            noise,
            steps=4,
            prepare=lambda k: make().apply(params, k, method="embed_step"),
        )

    with jax.disable_jit():
        each_time = diffusion.ddim_sample(
            lambda x, k: apply(params, x, jnp.full(3, k), cond), noise, steps=4
        )
    np.testing.assert_allclose(once(cond), each_time, atol=1e-4)


def test_bfloat16_is_close_and_keeps_float32_parameters(params, apply):
    half = make(dtype=jnp.bfloat16)
    shapes = jax.eval_shape(half.init, KEY, *data())
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(shapes))
    exact, rough = apply(params, *data()), jax.jit(half.apply)(params, *data())
    assert rough.dtype == jnp.float32
    error = float(jnp.sqrt(((rough - exact) ** 2).mean() / (exact**2).mean()))
    assert 1e-5 < error < 0.05


def test_wrong_shapes_are_named(params):
    x, k, cond = data()
    with pytest.raises(ValueError, match=r"x: expected \[B, H, 4\] with H divisible by 2, got"):
        make().apply(params, x[:, :3], k, cond)
    with pytest.raises(ValueError, match=r"cond: expected \[B, 10\], got \(3, 9\)"):
        make().apply(params, x, k, cond[:, :9])


def test_blocks_halvings_and_skips_follow_each_other_as_published(params, apply):
    x, k, cond = data()
    inner = params["params"]
    film = make().apply(params, cond, method="condition")
    film = iter(
        jnp.split(
            film + make().apply(params, k, method="embed_step"), [16, 32, 64, 96, 128, 160, 176], -1
        )
    )

    def part(module, name, *given):
        return jax.jit(module.apply)({"params": inner[name]}, *given)

    def blocks(x, features, *names):
        for name in names:
            x = part(unet1d.ResidualBlock(features, 5, 4), name, x, next(film))
        return x

    high = blocks(x, 8, "down_0_0", "down_0_1")
    low = part(layers.Conv1d(8, 3, stride=2), "halve_0", high)
    low = blocks(low, 16, "down_1_0", "down_1_1")
    deep = blocks(low, 16, "middle_0", "middle_1")
    y = blocks(jnp.concatenate([deep, low], -1), 8, "up_0_0", "up_0_1")
    y = part(unet1d.ConvBlock(8, 5, 4), "last", part(layers.Upsample1d(), "double_0", y))
    expected = part(layers.Conv1d(4, 1), "out", y)
    np.testing.assert_allclose(apply(params, x, k, cond), expected, atol=1e-5)
