"""What an episode draws, and when its block counts as transferred."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax.core.types import Pose
from starjax.tasks.peg_transfer import task

PEG = jnp.array([0.02, 0.0])


@pytest.mark.parametrize(
    ("off", "tilt", "threaded", "near"),
    [
        ((0.0, 0.0), 0.0, True, True),
        ((0.0045, 0.0), 0.0, True, True),
        ((-0.0062, 0.0), 0.0, False, False),
        ((0.0, 0.0012), 0.0, True, True),
        ((0.0, 0.002), 0.0, False, True),
        ((0.0, -0.002), 0.0, False, True),
        ((0.0, 0.005), 0.0, False, False),
        ((0.0, 0.0), 0.15, True, True),
        ((0.0, 0.0), 0.2, False, True),
    ],
)
def test_success_wants_the_peg_in_the_opening_and_the_block_standing(off, tilt, threaded, near):
    """`off` is aside and above, in m, `tilt` in rad."""
    c, s = np.cos(tilt), np.sin(tilt)
    R = jnp.array([[c, 0, s], [0, 1, 0], [-s, 0, c]], jnp.float32)
    aside, above = off
    block = Pose(R, jnp.array([0.02 + aside, 0.0, task.RIM_HEIGHT + above]))
    assert bool(task.is_threaded(block, PEG)) == threaded
    assert bool(task.is_near(block, PEG)) == near


def test_a_block_at_rest_neither_moves_nor_spins():
    def is_at_rest(along=0.0, around=0.0):
        return bool(task.is_at_rest(jnp.array([along, 0, 0, 0, 0, around])))

    assert is_at_rest() and is_at_rest(along=0.005, around=0.3)
    assert not is_at_rest(along=0.02) and not is_at_rest(around=0.6)


def test_every_peg_and_the_whole_of_each_range_are_drawn(sim):
    draw = jax.vmap(lambda key: task.sample(sim.bound, key))
    found = jax.jit(draw)(jax.random.split(jax.random.key(0), 400))
    assert set(np.unique(found.source)) == set(range(6))
    assert set(np.unique(found.target)) == set(range(6, 12))
    yaw = np.arctan2(found.block.R[:, 1, 0], found.block.R[:, 0, 0])
    assert -task.BLOCK_YAW <= yaw.min() < -0.45 and yaw.max() > 0.45
    spread = task.TIP_SPREAD
    off = np.asarray(found.tip) - task.TIP_HOME
    assert (off.min(0) < -0.9 * spread).all() and (off.max(0) > 0.9 * spread).all()
    assert (np.abs(off) <= 1.001 * spread).all()
