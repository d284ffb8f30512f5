"""What is called a collision."""

import jax
import jax.numpy as jnp
import pytest

from starjax.core.types import Pose
from starjax.sim import collision
from starjax.tasks.peg_transfer import task

UP = jnp.full((6, 3), 0.5)  # joints of an arm that is nowhere near
DOWN = jnp.array([[1.0, 0, 0], [0, -1.0, 0], [0, 0, -1.0]])
LYING = jnp.array([[0, 0, 1.0], [0, 1.0, 0], [-1.0, 0, 0]])  # a tool along x
BLOCK, PEG = jnp.array([0.02, 0.0, task.RIM_HEIGHT]), jnp.array([[0.02, 0.0]])
FAR = 1.0  # m
KEY = jax.random.key(0)
OUTSIDE = jnp.array([0.0, 0.0, 0.15])


@pytest.fixture
def is_hit(sim):
    """For a tool at `p`; the block and the peg are so far from x = 0.02."""

    def is_hit(R, p, origins=UP, block=FAR, peg=FAR):
        there = Pose(jnp.eye(3), BLOCK + block)
        measurements = task.PegMeasurements(there, jnp.zeros(6), jnp.zeros(3), jnp.zeros((), bool))
        bound, layout = sim.bound._replace(pegs=PEG + peg), task.sample(sim.bound, KEY)
        obstacles = task.obstacles(bound, layout, measurements)
        pose = Pose(R[None], jnp.array([p]))
        situation = (sim.arms, pose, [origins], OUTSIDE[None], obstacles, 0.0)
        hit = bool(collision.detect(*situation))
        assert hit == any(map(bool, collision.pairs(*situation).values()))
        return hit

    return is_hit


@pytest.mark.parametrize("x", [0.0, 0.02])
def test_jaws_may_reach_down_to_a_peg_but_not_into_the_board(is_hit, x):
    assert not is_hit(DOWN, [x, 0.0, 0.03], peg=0.0)
    assert is_hit(DOWN, [x, 0.0, 0.0])


def test_a_shaft_may_touch_no_peg_and_no_block(is_hit):
    beside = [0.04, 0.0, 0.006]
    assert not is_hit(LYING, beside)
    assert is_hit(LYING, beside, peg=0.0) and not is_hit(LYING, beside, peg=0.02)
    assert is_hit(LYING, beside, block=0.0)


@pytest.mark.parametrize(("clearance", "hit"), [(3e-4, False), (-4e-4, False), (-6e-4, True)])
def test_a_shaft_may_lie_closely_above_a_peg(is_hit, sim, clearance, hit):
    tool = sim.arms[0].tool
    above = [0.02 + tool.shaft_end, 0.0, task.PEG_HEIGHT + clearance + tool.shaft_radius]
    assert is_hit(LYING, above, peg=0.0) == hit and not is_hit(LYING, above)


def test_an_arm_keeps_its_distance_from_the_board(is_hit):
    assert is_hit(DOWN, [0.0, 0.0, 0.03], origins=UP.at[3, 2].set(0.04))


@pytest.mark.parametrize(("apart", "hit"), [(0.006, False), (0.004, True)])
def test_two_shafts_may_cross_but_not_overlap(sim, apart, hit):
    arms = sim.arms * 2
    tips = jnp.array([[0.02, 0.0, 0.03], [-0.02, apart, 0.03]])
    trocars = jnp.array([[-0.02, 0.0, 0.15], [0.02, apart, 0.15]])
    axis = tips - trocars
    axis = axis / jnp.linalg.norm(axis, axis=1, keepdims=True)
    side = jnp.tile(jnp.array([0.0, 1.0, 0.0]), (2, 1))
    R = jnp.stack([jnp.cross(side, axis), side, axis], -1)
    nothing = task.Capsules(jnp.zeros((1, 3)) - 9, jnp.zeros((1, 3)) - 9, jnp.zeros(1))
    links = [UP, UP + 1.0]
    assert bool(collision.detect(arms, Pose(R, tips), links, trocars, nothing, 0.0)) == hit


def test_links_of_two_arms_keep_apart(sim):
    tips = jnp.array([[-0.1, 0.0, 0.03], [0.1, 0.0, 0.03]])
    trocars = tips.at[:, 2].set(0.15)
    pose = Pose(jnp.stack([DOWN, DOWN]), tips)
    nothing = task.Capsules(jnp.zeros((1, 3)) - 9, jnp.zeros((1, 3)) - 9, jnp.zeros(1))
    for away, hit in ((0.2, False), (0.05, True)):
        links = [UP, UP + jnp.array([away, 0.0, 0.0])]
        found = collision.detect(sim.arms * 2, pose, links, trocars, nothing, 0.0)
        assert bool(found) == hit


def test_the_pair_of_a_collision_is_named(sim):
    pose, origins = Pose(DOWN[None], jnp.array([[0.0, 0.0, 0.0]])), [UP.at[3, 2].set(0.04)]
    peg = task.Capsules(jnp.zeros((2, 3)).at[0].set(9.0), jnp.zeros((2, 3)) + 0.03, jnp.ones(2))
    hits = collision.pairs(sim.arms, pose, origins, OUTSIDE[None], peg, 0.0)
    assert sorted(name for name, hit in hits.items() if hit) == [
        "arm 0: jaws, floor",
        "arm 0: links, table",
        "arm 0: shaft, obstacle 0",
        "arm 0: shaft, obstacle 1",
    ]
