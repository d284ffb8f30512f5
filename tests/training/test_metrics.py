"""What a line of the training's log says of the steps since the one before."""

import jax
import jax.numpy as jnp
import mistakes
import pytest

from starjax.core import config
from starjax.training import metrics

SETTINGS = config.TrainConfig(log_every=3)


def means(step, skipped, /, **sums):
    return metrics.means(jax.tree.map(jnp.float32, sums), step, skipped, SETTINGS)


def added(*losses):
    """Sums after steps with these losses."""
    sums = metrics.zeros([])
    for loss in losses:
        found = {"loss": jnp.float32(loss), "gradient_norm": jnp.float32(1.0)}
        sums = metrics.added(sums, found, jnp.isfinite(loss))
    return sums


def test_means_are_of_the_steps_that_were_taken():
    found = metrics.means(added(1.0, jnp.nan, 5.0), 3, 1, SETTINGS)
    assert found == {"loss": 3.0, "gradient_norm": 1.0, "skipped": 1}


def test_restarted_sums_are_of_no_step():
    assert metrics.restarted(added(1.0)) == metrics.zeros([])


def test_a_stretch_without_a_finite_loss_is_a_mistake():
    for step, here, of_all in ((12, 3, 3), (2, 1, 2)):
        with mistakes.of("train.learning_rate"):
            means(step, of_all, loss=0.0, taken=0, skipped=here)


@pytest.mark.parametrize("step", [1, 13])
def test_a_single_step_that_is_broken_is_none(step):
    """As where the end cuts the stretch short."""
    assert means(step, 1, loss=0.0, taken=0, skipped=1) == {"skipped": 1}
