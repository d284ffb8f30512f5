"""Six blocks in one episode: turns of the tools, resting parts, the path between. No physics:
a block is put down at its peg whenever the tools have withdrawn for so many control steps."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax import rcm
from starjax.addons.six_blocks import environment as six_blocks
from starjax.addons.six_blocks import task as six
from starjax.core.types import Agent, Command, Pose
from starjax.sim import env as envs
from starjax.sim import scene
from starjax.tasks.peg_transfer_bimanual import task

WORK = 5  # control steps of an agent's own that a block takes
ASIDE = jnp.array([0.001, -0.002, 0.0])  # m from its peg, where each block is put
DONE = jnp.array([0.03, 0.01, 0.012])  # m, where the tips are then


def put_down(state, command):
    """A step of an environment without physics."""
    worked = state.step + 1 - state.layout.since - six_blocks.WITHDRAWN * (state.layout.turn > 0)
    success = worked == WORK
    there = jnp.append(state.layout.target_peg, task.single.RIM_HEIGHT) + ASIDE
    p = jnp.where(success, there, state.measurements.block.p)
    tips = jnp.where(success, jnp.stack([DONE, DONE]), command.pose.p)
    return state.replace(
        step=state.step + 1,
        measurements=state.measurements.replace(block=Pose(state.measurements.block.R, p)),
        pose=Pose(command.pose.R, tips),
        success=success,
        done=success,
    )


@pytest.fixture(scope="module")
def played():
    """States before every step and after the last, and how often an agent's memory began."""
    real = envs.make(six.TASK.name, observation="state", variant=six.TASK)
    env = six_blocks.wrap(real._replace(step=put_down))
    trocars = rcm.Trocar(*(jnp.asarray(field[-1]) for field in env.task.trocars))

    def act(memory, state):
        command = Command(Pose(state.pose.R, state.pose.p), -jnp.ones(2))
        return command, memory + 1, command

    counting = six_blocks.reset_each_block(Agent(lambda key, state: jnp.zeros((), jnp.int32), act))

    def step(carry, _):
        state, memory = carry
        command, memory, _ = counting.act(memory, state)
        return (env.step(state, command), memory), (state, memory[1])

    @jax.jit
    def play(key):
        state = env.reset(key, envs.EnvParams(trocars))
        start = state, counting.init(key, state)
        total = six.BLOCKS * WORK + (six.BLOCKS - 1) * six_blocks.WITHDRAWN
        (last, _), (states, memories) = jax.lax.scan(step, start, None, length=total)
        return states, memories, last, env.labels(last)

    return env, *play(jax.random.key(3))


def test_every_block_has_its_turn(played):
    env, states, _, last, labels = played
    turns = np.asarray(states.layout.turn)
    begins = np.flatnonzero(np.diff(turns)) + 1
    assert turns.max() == 5 and len(begins) == 5 and labels["moved"] == 6
    assert set(labels) == set(env.task.labels)
    assert last.success and last.done and not states.done.any()
    sources, targets = (
        np.asarray(x)[[0, *begins]] for x in (states.layout.source, states.layout.target)
    )
    assert sorted(sources) == list(range(6)) and sorted(targets) == list(range(6, 12))


def test_what_is_over_stands_where_it_was_put(played):
    env, states, _, last, _ = played
    pegs = env.scene.bound.pegs
    wanted = pegs[np.asarray(last.layout.targets[:5])] + np.asarray(ASIDE[:2])
    still = six.still(last.layout)
    np.testing.assert_allclose(still.p[:, :2], wanted, atol=1e-6)
    qpos = np.asarray(last.physics.qpos)
    at = env.scene.bound.block
    np.testing.assert_allclose(qpos[at : at + 3], last.layout.blocks.p[5], atol=1e-6)
    arms = np.concatenate([bound.q for bound in env.scene.arms])
    np.testing.assert_array_equal(qpos[arms], np.asarray(states.physics.qpos[0])[arms])


def test_the_tools_withdraw_before_the_next_block(played):
    _, states, memories, _, _ = played
    begins = np.flatnonzero(np.diff(np.asarray(states.layout.turn))) + 1
    tips = np.asarray(states.pose.p)
    for k in begins:
        np.testing.assert_allclose(tips[k], np.stack([DONE, DONE]), atol=1e-6)
        up = tips[k + six_blocks.RISE]
        np.testing.assert_allclose(up[:, :2], tips[k][:, :2], atol=1e-5)
        np.testing.assert_allclose(up[:, 2], six_blocks.HEIGHT, atol=1e-5)
        np.testing.assert_allclose(tips[k + six_blocks.WITHDRAWN], task.PARK, atol=1e-5)
    # The agent begins anew when it is its turn, and at no other time.
    began = np.flatnonzero(np.asarray(memories) == 1)
    np.testing.assert_array_equal(began, [0, *(begins + six_blocks.WITHDRAWN)])


@pytest.mark.slow
def test_what_stands_still_is_seen(played):
    env, states, _, _, _ = played
    state = jax.tree.map(lambda x: x[0], states)
    data = envs.physics.kinematics(
        env.scene, state.physics.qpos, state.trocar.p_world_trocar, state.layout
    )
    m = env.scene.mj_model
    bodies = [m.body(f"still{i}").id for i in range(5)]
    still = six.still(state.layout)
    np.testing.assert_allclose(data.xpos[np.array(bodies)], still.p, atol=1e-6)
    np.testing.assert_allclose(data.xmat[np.array(bodies)], still.R, atol=1e-5)
    assert (
        len(env.task.obstacles(env.scene.bound, state.layout, state.measurements).radius) == 12 + 18
    )
    usual = scene.compose(scene.name("peg_transfer_bimanual"))
    assert (m.nq, m.nv, m.nu) == (usual.nq, usual.nv, usual.nu)
