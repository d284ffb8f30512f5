"""Judgements of needle pick that need no simulation."""

import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax import rcm
from starjax.core.types import Pose
from starjax.tasks.needle_pick import expert, task

BOUND = task.NeedleBound(needle=0, dof=0, height=0.0, point=np.array([]), pads=np.array([]))


@pytest.mark.parametrize("away, speed, sound", [(6.0, 0.1, True), (0.1, 30.0, False)])
def test_a_needle_may_roll_away_for_a_minute_but_not_fly(away, speed, sound):
    place = jnp.array([away, 0.0, 0.003, 1.0, 0.0, 0.0, 0.0])
    motion = jnp.array([0.0, -speed, 0.0, 0.0, 0.0, 0.0])
    assert bool(task.is_sound(BOUND, place, motion)) == sound


@pytest.mark.parametrize(("angles", "last"), [(None, 5), (np.zeros((1, 2), np.float32), 4)])
def test_wide_jaws_take_no_segment_beside_the_point(angles, last):
    """In C MuJoCo pads of a tool with a wrist touch the point there, which is no success."""

    def segment(key, yaw):
        measured = types.SimpleNamespace(
            needle=Pose(rcm.rotation_z(yaw), jnp.zeros(3)), touch=jnp.zeros((), bool)
        )
        tip = Pose(jnp.eye(3)[None], jnp.array([[0.0, 0.0, 0.05]]))
        layout = types.SimpleNamespace(needle=measured.needle)
        state = types.SimpleNamespace(pose=tip, layout=layout, measurements=measured, wrist=angles)
        return expert.init(key, state).segment

    keys, yaws = jax.random.split(jax.random.key(0), 300), jnp.linspace(-3.0, 3.0, 300)
    found = jax.vmap(segment)(keys, yaws)
    assert found.min() == 1 and found.max() == last
