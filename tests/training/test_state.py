"""The optimiser, as the paper sets it, and the metrics between two lines of the log."""

import chex
import jax
import jax.numpy as jnp
import mistakes
import optax
import pytest

from starjax.core import config
from starjax.policies.models import kernels
from starjax.policies.models.kernels import packed_params
from starjax.training import state

LINES = config.TrainConfig(log_every=3)


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


def means(step, skipped, /, **sums):
    return state.mean_metrics(jax.tree.map(jnp.float32, sums), step, skipped, LINES)


def added(*losses):
    """Sums after steps with these losses."""
    sums = state.zero_sums([])
    for loss in losses:
        found = {"loss": jnp.float32(loss), "gradient_norm": jnp.float32(1.0)}
        sums = state.add_metrics(sums, found, jnp.isfinite(loss))
    return sums


def test_means_are_of_the_steps_that_were_taken():
    found = state.mean_metrics(added(1.0, jnp.nan, 5.0), 3, 1, LINES)
    assert found == {"loss": 3.0, "gradient_norm": 1.0, "skipped": 1}


def test_restarted_sums_are_of_no_step():
    assert state.restarted(added(1.0)) == state.zero_sums([])


def test_a_stretch_without_a_finite_loss_is_a_mistake():
    for step, here, of_all in ((12, 3, 3), (2, 1, 2)):
        with mistakes.of("train.learning_rate"):
            means(step, of_all, loss=0.0, taken=0, skipped=here)


@pytest.mark.parametrize("step", [1, 13])
def test_a_single_step_that_is_broken_is_none(step):
    """As where the end cuts the stretch short."""
    assert means(step, 1, loss=0.0, taken=0, skipped=1) == {"skipped": 1}
