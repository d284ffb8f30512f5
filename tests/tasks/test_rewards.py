"""Rewards in stages: laws of the number of a stage and of the terms within it."""

import jax.numpy as jnp
import pytest

from starjax.tasks import rewards

STAGES = ("far", "held", "lifted", "done")
TERMS = {"far": jnp.float32(0.5), "lifted": jnp.float32(0.25)}


def staged(stage, success=False):
    return float(rewards.staged(STAGES, TERMS, jnp.int32(stage), jnp.bool_(success)))


def test_the_last_condition_that_holds_is_the_stage():
    flags = [jnp.bool_(x) for x in (True, False, True, False)]
    stage = rewards.last_reached(*flags)
    assert int(stage) == 3 and stage.dtype == jnp.int32
    assert int(rewards.last_reached(*map(jnp.bool_, (False, False)))) == 0


@pytest.mark.parametrize(("stage", "term"), [(0, 0.5), (1, 0.5), (2, 0.25), (3, 0.25)])
def test_a_term_counts_from_its_stage_until_the_next_named_one(stage, term):
    assert staged(stage) == pytest.approx((stage + term) / 4)


def test_success_is_the_largest_reward():
    assert staged(3, success=True) == 1.0 > max(map(staged, range(4)))


def test_nearness_is_one_at_the_goal_and_falls_with_the_scale():
    assert float(rewards.nearness(jnp.float32(0.0), 0.03)) == 1.0
    assert float(rewards.nearness(jnp.float32(0.03), 0.03)) == pytest.approx(1 / jnp.e)
