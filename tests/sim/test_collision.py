"""What is called a collision."""

import jax.numpy as jnp
import pytest

from starjax.sim import collision
from starjax.sim.tasks.peg_transfer import task
from starjax.types import Pose

UP = jnp.full((6, 3), 0.5)  # joints of an arm that is nowhere near
DOWN = jnp.array([[1.0, 0, 0], [0, -1.0, 0], [0, 0, -1.0]])
LYING = jnp.array([[0, 0, 1.0], [0, 1.0, 0], [-1.0, 0, 0]])  # a tool along x
BLOCK, PEG = jnp.array([0.02, 0.0, task.RIM_HEIGHT]), jnp.array([[0.02, 0.0]])
FAR = 1.0  # m


def is_hit(R, p, origins=UP, block=FAR, peg=FAR):
    """Of a tool at `p`; the block and the peg are so far from x = 0.02."""
    there = Pose(jnp.eye(3), BLOCK + block)
    return bool(collision.detect(Pose(R, jnp.array(p)), origins, there, PEG + peg))


@pytest.mark.parametrize("x", [0.0, 0.02])
def test_jaws_may_reach_down_to_a_peg_but_not_into_the_board(x):
    assert not is_hit(DOWN, [x, 0.0, 0.03], peg=0.0)
    assert is_hit(DOWN, [x, 0.0, 0.0])


def test_a_shaft_may_touch_no_peg_and_no_block():
    beside = [0.04, 0.0, 0.006]
    assert not is_hit(LYING, beside)
    assert is_hit(LYING, beside, peg=0.0) and not is_hit(LYING, beside, peg=0.02)
    assert is_hit(LYING, beside, block=0.0)


@pytest.mark.parametrize(("clearance", "hit"), [(3e-4, False), (-4e-4, False), (-6e-4, True)])
def test_a_shaft_may_lie_closely_above_a_peg(clearance, hit):
    height = task.PEG_HEIGHT + clearance + collision.SHAFT_RADIUS
    above = [0.02 + collision.SHAFT_END, 0.0, height]
    assert is_hit(LYING, above, peg=0.0) == hit and not is_hit(LYING, above)


def test_an_arm_keeps_its_distance_from_the_board():
    assert is_hit(DOWN, [0.0, 0.0, 0.03], origins=UP.at[3, 2].set(0.04))
