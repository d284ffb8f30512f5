"""The roll network: Eq. 13's inputs all matter, and it starts by saying "no roll"."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from starjax.policies.models import roll_net

KEY = jax.random.key(0)
MODULE = roll_net.RollNet(width=32, embed_dim=8)


def inputs(batch=64):
    rng = np.random.default_rng(1)
    shapes = ((batch, 16, 3), (batch, 7), (batch, 2))
    return tuple(jnp.asarray(rng.uniform(-1.0, 1.0, shape), jnp.float32) for shape in shapes)


def target(p, trocar, history):
    """A roll that needs each of the inputs."""
    return 0.5 * p[..., 0] * trocar[:, :1] + 0.3 * history[:, -1:]


@pytest.fixture(scope="module")
def trained():
    params = jax.jit(MODULE.init)(KEY, *inputs())
    optimizer = optax.adam(3e-3)

    @jax.jit
    def step(carry, _):
        params, state = carry
        loss, gradient = jax.value_and_grad(
            lambda p: ((MODULE.apply(p, *inputs()) - target(*inputs())) ** 2).mean()
        )(params)
        updates, state = optimizer.update(gradient, state)
        return (optax.apply_updates(params, updates), state), loss

    (params, _), losses = jax.lax.scan(step, (params, optimizer.init(params)), None, 200)
    return params, losses


def test_starts_at_zero():
    rolls, _ = jax.jit(MODULE.init_with_output)(KEY, *inputs())
    assert rolls.shape == (64, 16)
    np.testing.assert_array_equal(rolls, 0.0)


def test_learns_and_uses_every_input(trained):
    params, losses = trained
    assert float(losses[-1]) < 0.02 * float(losses[0])
    total = lambda *x: MODULE.apply(params, *x).sum()  # noqa: E731
    gradients = jax.jit(jax.grad(total, (0, 1, 2)))(*inputs())
    for gradient in gradients:
        assert jnp.isfinite(gradient).all()
        assert float(jnp.abs(gradient).max()) > 1e-3


def test_bfloat16_is_close(trained):
    params, _ = trained
    half = roll_net.RollNet(width=32, embed_dim=8, dtype=jnp.bfloat16)
    rough = jax.jit(half.apply)(params, *inputs())
    assert rough.dtype == jnp.float32
    exact = jax.jit(MODULE.apply)(params, *inputs())
    assert 0 < float(jnp.abs(rough - exact).max()) < 0.05


def test_size_of_the_papers_network():
    shapes = jax.eval_shape(roll_net.RollNet().init, KEY, *inputs(1))
    size = sum(leaf.size for leaf in jax.tree.leaves(shapes))
    linear = lambda a, b: a * b + b  # noqa: E731
    block = 2 * 256 + 2 * linear(256, 256)
    assert size == linear(7, 64) + linear(48 + 64 + 2, 256) + 3 * block + linear(256, 16)


def test_it_is_a_residual_mlp_with_gelu(trained):
    """In numpy, by its docstring; trained, because an untrained one returns 0."""
    params, (x, trocar, history) = trained[0]["params"], inputs()

    def gelu(x):
        return 0.5 * x * (1 + np.tanh(np.sqrt(2 / np.pi) * (x + 0.044715 * x**3)))

    def dense(name, x):
        return x @ np.asarray(params[name]["kernel"], float) + np.asarray(params[name]["bias"])

    x = np.concatenate([x.reshape(len(x), -1), gelu(dense("embed", trocar)), history], -1)
    x = dense("project", x)
    for i in range(3):
        norm = params[f"LayerNorm_{i}"]
        h = (x - x.mean(-1, keepdims=True)) / np.sqrt(x.var(-1, keepdims=True) + 1e-6)
        h = dense(f"Dense_{2 * i}", h * np.asarray(norm["scale"]) + np.asarray(norm["bias"]))
        x = x + dense(f"Dense_{2 * i + 1}", gelu(h))
    np.testing.assert_allclose(MODULE.apply(trained[0], *inputs()), dense("out", x), atol=1e-4)
