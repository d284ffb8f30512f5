"""The expert of peg transfer enters episodes that others began: without a jolt, never dropping."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax.addons.finetune.rescuers import peg_transfer as rescue
from starjax.core.types import Pose
from starjax.tasks import phases, scripting
from starjax.tasks.peg_transfer import expert, task

KEYS = jax.random.split(jax.random.key(3), 12)


@pytest.fixture(scope="module")
def enter():
    """`EnvState -> the memory, and the first command`."""

    def one(key, state):
        memory = rescue.RESCUER.resume(key, state)
        return memory, rescue.RESCUER.act(memory, state)[0]

    compiled = jax.jit(jax.vmap(one))
    return lambda state: compiled(KEYS, state)


def turned(state, roll, p, jaws):
    """The state with tools at `p`, turned by `roll`, and jaws commanded to `jaws`."""
    jaws = jnp.full_like(state.gripper_target, jaws)
    pose = jax.vmap(scripting.command)(jnp.full_like(jaws, roll), p, jaws, state).pose
    return state.replace(pose=pose, gripper_target=jaws)


def holding(state, off, height):
    """The state with a block in closed jaws, `off` from above its peg, the tip at `height`."""
    block = state.layout.block
    xy = block.p[:, :2] + off
    block = Pose(block.R, jnp.concatenate([xy, jnp.full((12, 1), height)], -1))
    wall = block.p + task.RIM_RADIUS * jax.vmap(task.wall_normals)(block)[:, 0]
    state = turned(state, 0.3, wall[:, None], -0.9)
    return state.replace(
        measurements=state.measurements.replace(block=block), touch=jnp.ones((12, 1), bool)
    )


def test_at_reset_it_acts_like_the_expert(reset, enter):
    state = reset(5)
    memory, command = enter(state)
    theirs = jax.jit(jax.vmap(expert.AGENT.init))(KEYS, state)
    act = jax.jit(jax.vmap(expert.AGENT.act))
    assert (memory.phase == theirs.phase).all() and (memory.attempt == theirs.attempt).all()
    for ours, expected in zip(jax.tree.leaves(command), jax.tree.leaves(act(theirs, state)[0])):
        np.testing.assert_allclose(ours, expected, atol=2e-6)


@pytest.mark.parametrize(
    ("off", "height", "phase"),
    [(0.01, 0.009, expert.LIFT), (0.01, 0.05, expert.CARRY)],
)
def test_jaws_that_hold_stay_closed_and_do_not_turn(reset, enter, off, height, phase):
    state = holding(reset(5), np.array([off, 0.0]), height)
    memory, command = enter(state)
    assert (memory.phase == phase).all()
    assert (command.gripper <= -0.9).all() and (memory.jaws_from == np.float32(-0.9)).all()
    np.testing.assert_allclose(command.pose.R, state.pose.R, atol=0.02)
    np.testing.assert_allclose(command.pose.p, state.pose.p, atol=1e-3)


def test_a_block_about_its_target_is_lowered(reset, enter):
    state = reset(5)
    off = np.asarray(state.layout.target_peg - state.layout.block.p[:, :2])
    memory, _ = enter(holding(state, off, 0.012))
    assert (memory.phase == expert.LOWER).all()


def test_low_tools_rise_before_they_go_sideways(reset, enter):
    state = reset(5)
    low = state.pose.p.at[..., 2].set(0.01)
    memory, command = enter(turned(state, -0.6, low, -1.0))
    assert (memory.phase == phases.RAISE).all()
    np.testing.assert_allclose(memory.goal[:, :2], low[:, 0, :2], atol=1e-6)
    np.testing.assert_allclose(memory.goal[:, 2], rescue.HIGH, atol=1e-6)
    np.testing.assert_allclose(command.pose.p[..., :2], low[..., :2], atol=1e-3)
    assert (command.gripper > -1.0).all()
