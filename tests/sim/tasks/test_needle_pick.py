"""Judgements of needle pick that need no simulation."""

import jax.numpy as jnp
import numpy as np
import pytest

from starjax.sim.tasks.needle_pick import task

BOUND = task.NeedleBound(needle=0, dof=0, height=0.0, point=np.array([]), pads=np.array([]))


@pytest.mark.parametrize("away, speed, sound", [(6.0, 0.1, True), (0.1, 30.0, False)])
def test_a_needle_may_roll_away_for_a_minute_but_not_fly(away, speed, sound):
    place = jnp.array([away, 0.0, 0.003, 1.0, 0.0, 0.0, 0.0])
    motion = jnp.array([0.0, -speed, 0.0, 0.0, 0.0, 0.0])
    assert bool(task.is_sound(BOUND, place, motion)) == sound
