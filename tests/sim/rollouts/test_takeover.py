"""The signals of a takeover, and the expert that begins at the state of the signal."""

import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stubs

from starjax import rcm
from starjax.core.types import Command, Pose
from starjax.sim import env as sim_env
from starjax.sim.rescuer import Rescuer
from starjax.sim.rollouts import agent, progress, takeover


def stalls(rewards, steps=4, held=()):
    memory, found = progress.begin(), []
    for step, reward in enumerate(rewards):
        state = types.SimpleNamespace(
            reward=jnp.float32(reward), step=jnp.int32(step), settled=jnp.int32(step in held)
        )
        memory, stalled = progress.update(memory, state, steps)
        found.append(bool(stalled))
    return found


def test_an_episode_stalls_once_its_best_reward_is_old():
    assert stalls([0.1, 0.2, 0.2, 0.2, 0.2]) == [False] * 5
    assert stalls([0.1, 0.2, 0.2, 0.2, 0.2, 0.2]) == [False] * 5 + [True]
    # Less than the gain, and a reward that comes back to its best, count for nothing.
    assert stalls([0.5, 0.51, 0.515, 0.519, 0.519])[-1]
    assert stalls([0.5, 0.3, 0.4, 0.5, 0.5])[-1]
    assert not stalls([0.5, 0.3, 0.4, 0.53, 0.5])[-1]


def test_an_episode_has_not_stalled_while_the_conditions_of_success_hold():
    assert not any(stalls([0.5] + 10 * [1.0], held=range(1, 11)))
    assert stalls([1.0] * 6, held=[0, 1]) == [False] * 5 + [True]


@pytest.mark.parametrize(
    ("signals", "cause"),
    [
        ((0, 0, 0), "none"),
        ((1, 0, 0), "stalled"),
        ((1, 1, 0), "clock"),
        ((0, 1, 1), "nearly lost"),
    ],
)
def test_the_most_urgent_cause_counts(signals, cause):
    number = progress.cause(*map(jnp.bool_, signals))
    assert progress.CAUSES[int(number)] == cause and number.dtype == np.int32


def spells(state, first):
    """A command that says when its agent began, and the present step."""
    p = jnp.stack([first, state.step.astype(jnp.float32), 0.0])[None]
    return Command(Pose(state.pose.R, p), jnp.ones(1))


def spy(lost_at):
    def act(first, state):
        command = spells(state, first)
        return command, first, command

    def resume(key, state):
        return state.step.astype(jnp.float32)

    return Rescuer(resume, act, lambda state: state.step >= lost_at)


@pytest.mark.parametrize(
    ("lost_at", "limits", "held", "begins", "cause"),
    [
        (99, (20, 6), (), 6, "stalled"),
        (99, (4, 6), (), 4, "clock"),
        (99, (4, 6), (3, 4, 5), 6, "clock"),
        (3, (20, 6), (), 3, "nearly lost"),
    ],
)
def test_the_expert_begins_at_the_state_of_the_signal_and_stays(
    lost_at, limits, held, begins, cause
):
    def policy_act(params, memory, state, observe, t):
        command = Command(state.pose, -jnp.ones((2, 1)))
        return command, memory + 1, command

    policy = agent.BatchAgent(lambda params, keys, state, observe: jnp.zeros(2), policy_act, {})
    both = takeover.from_policy(policy, spy(lost_at))
    env = stubs.make_env(unlucky=0.0)
    trocar = rcm.Trocar(*(jnp.asarray(x) for x in stubs.trocars(0, 1)))
    keys = jax.random.split(jax.random.key(0), 2)
    state = jax.vmap(env.reset)(keys, sim_env.EnvParams(trocar))
    clock, stalled = limits
    params = (None, takeover.TakeoverLimits(np.full(2, clock), np.int32(stalled)))
    memory = both.init(params, keys, state, None)
    for step in range(9):
        settled = jnp.full(2, step in held, jnp.int32)  # the conditions of success hold
        state = state.replace(step=jnp.full(2, step), settled=settled)
        executed, memory, label = both.act(params, memory, state, None, step)
        np.testing.assert_array_equal(executed.gripper, 1.0 if step >= begins else -1.0)
        jax.tree.map(np.testing.assert_array_equal, executed, label)
        if step >= begins:
            np.testing.assert_array_equal(executed.pose.p[:, 0, 0], begins)
            np.testing.assert_array_equal(executed.pose.p[:, 0, 1], step)
    assert {progress.CAUSES[number] for number in memory.cause.tolist()} == {cause}


@pytest.mark.parametrize("bends", ("policy", "expert"))
def test_one_of_the_two_may_leave_the_wrist_straight(bends):
    angles = {"policy": None, "expert": None, bends: jnp.full((1, 2), 0.3)}

    def policy_act(params, memory, state, observe, t):
        turned = angles["policy"]
        turned = None if turned is None else jnp.stack([turned, turned])
        command = Command(state.pose, jnp.ones((2, 1)), turned)
        return command, memory, command

    def act(memory, state):
        command = Command(state.pose, jnp.ones(1), angles["expert"])
        return command, memory, command

    policy = agent.BatchAgent(lambda params, keys, state, observe: jnp.zeros(2), policy_act, {})
    both = takeover.from_policy(policy, Rescuer(lambda key, state: key, act))
    env = stubs.make_env(unlucky=0.0)
    trocar = rcm.Trocar(*(jnp.asarray(x) for x in stubs.trocars(0, 1)))
    keys = jax.random.split(jax.random.key(0), 2)
    state = jax.vmap(env.reset)(keys, sim_env.EnvParams(trocar))
    params = (None, takeover.TakeoverLimits(np.array([0, 9]), np.int32(9)))
    memory = both.init(params, keys, state, None)
    executed, _, label = both.act(params, memory, state, None, 0)
    bent = [0.3, 0.0] if bends == "expert" else [0.0, 0.3]
    for command in (executed, label):
        np.testing.assert_allclose(command.wrist[:, 0, 0], bent)
