"""The optimiser, as the paper sets it."""

import chex
import jax
import jax.numpy as jnp
import optax
import pytest

from starjax.core import config
from starjax.policies.models import kernels
from starjax.policies.models.kernels import packed_params
from starjax.training import state


def test_the_optimiser_is_adamw_with_the_momenta_of_the_paper():
    settings = config.TrainConfig(warmup_steps=0, weight_decay=0.5, learning_rate=0.1)
    optimizer = state.make_optimizer(settings)
    weight, gradient = {"w": jnp.array([2.0])}, {"w": jnp.array([3.0])}
    updates, after = optimizer.update(gradient, optimizer.init(weight), weight)
    step = {"w": jnp.array([-0.1 * (1.0 + 0.5 * 2.0)])}
    chex.assert_trees_all_close(updates, step, rtol=1e-5)

    def is_adam(node):
        return isinstance(node, optax.ScaleByAdamState)

    (adam,) = filter(is_adam, jax.tree.leaves(after, is_leaf=is_adam))
    wanted = {"w": jnp.array([0.05 * 3])}, {"w": jnp.array([0.001 * 9])}
    chex.assert_trees_all_close((adam.mu, adam.nu), wanted, rtol=1e-4)


@pytest.mark.parametrize("packs", [False, True])
def test_only_kernels_of_the_roll_network_decay_faster(packs):
    settings = config.TrainConfig(
        warmup_steps=0, weight_decay=0.25, roll_weight_decay=0.5, learning_rate=0.1
    )
    optimizer = state.make_optimizer(settings)
    kernel, bias = jnp.full((2, 3), 2.0), jnp.full(3, 2.0)
    network = {"params": {"out": {"kernel": kernel, "bias": bias}}}
    params = {"learner": network, "roll": network}
    given = packed_params.pack(params, params) if packs else params
    still = jax.tree.map(jnp.zeros_like, given)
    updates, _ = optimizer.update(still, optimizer.init(given), given)
    if packs:
        updates = kernels.unpacked(updates)
    slow, fast = -0.1 * 0.25 * 2.0, -0.1 * (0.25 + 0.5) * 2.0
    wanted = jax.tree.map(lambda x: jnp.full_like(x, slow), params)
    wanted["roll"]["params"]["out"]["kernel"] = jnp.full_like(kernel, fast)
    chex.assert_trees_all_close(updates, wanted, rtol=1e-5)
