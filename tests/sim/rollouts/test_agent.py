"""Agents in closed loop: observations, executed commands, and replays."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stubs

from starjax import rcm
from starjax.core import errors
from starjax.core.types import Command, Pose
from starjax.sim.rollouts import agent, engine, episodes

CENTRE = stubs.trocars(11)


def run(env, batch_agent, params=(None, None), trials=2, max_steps=30, record=episodes.SCORE):
    """All episodes of a group, by trial."""
    settings = engine.RolloutSettings(0, None, max_steps, trials)
    simulate = engine.make(env, batch_agent, CENTRE, settings, record)
    ended = [e for s in simulate(params, [(0, i) for i in range(trials)]) for e in s.ended]
    return sorted(ended, key=lambda episode: episode.trial)


def counting():
    """An environment that never ends and logs the commands that it gets in qpos."""
    base = stubs.make_env(unlucky=0.0)

    def reset(key, params):
        state = base.reset(key, params)
        return state.replace(physics=stubs.Physics(jnp.zeros(4)), gripper=jnp.zeros(1))

    def step(state, command):
        log = jnp.append(command.pose.p[0], command.gripper)
        number = state.step + 1
        return state.replace(
            physics=stubs.Physics(log), step=number, gripper=number.astype(jnp.float32)[None]
        )

    return base._replace(reset=reset, step=step)


def spy(horizon):
    """A policy whose commands spell the first and last step that it saw, and its plan's key."""

    def sample(params, stats, keys, observation, told):
        seen = observation.gripper[..., 0]  # the environment above shows the step's number
        p = jnp.stack([seen[:, 0], seen[:, -1], jax.vmap(jax.random.uniform)(keys)], -1)
        shape = (len(p), horizon, 1)
        poses = Pose(
            jnp.broadcast_to(jnp.eye(3), (*shape, 3, 3)),
            jnp.broadcast_to(p[:, None, None], (*shape, 3)),
        )
        return Command(poses, jnp.broadcast_to(jnp.arange(float(horizon))[:, None], shape))

    return sample


@pytest.mark.parametrize("horizon", [1, 2, 3, 5])
def test_history_and_plans_follow_the_paper(horizon):
    """Observes steps t - O + 1 .. t, executes the plan's first commands, then plans anew."""
    found = run(counting(), agent.from_policy(spy(6), horizon, 4), max_steps=10)
    for trial, episode in enumerate(found):
        log = episode.joined("reached_qpos")
        t = np.array([0, 0, 0, 0, 4, 4, 4, 4, 8, 8])
        np.testing.assert_array_equal(log[:, 3], [0, 1, 2, 3, 0, 1, 2, 3, 0, 1])
        np.testing.assert_array_equal(log[:, 1], t)
        np.testing.assert_array_equal(log[:, 0], np.maximum(t - horizon + 1, 0))
        key = jax.random.fold_in(jax.random.fold_in(jax.random.key(0), 0), trial)
        _, key = jax.random.split(key)
        noise = [float(jax.random.uniform(jax.random.fold_in(key, r))) for r in range(3)]
        np.testing.assert_allclose(log[:, 2], np.repeat(noise, [4, 4, 2]), rtol=1e-6)


@pytest.mark.parametrize(("horizon", "looks"), [(1, 3), (2, 5), (4, 9)])
def test_a_policy_looks_only_at_the_moments_that_its_plans_need(horizon, looks):
    env, count = counting(), []

    def observe(state):
        jax.debug.callback(lambda: count.append(1))
        return counting().observe(state)

    run(env._replace(observe=observe), agent.from_policy(spy(4), horizon, 4), max_steps=9)
    jax.effects_barrier()
    # At steps 0, 4 and 8, and at the O - 1 before each of the last two.
    assert len(count) == looks


def test_a_policy_is_told_what_the_environment_tells():
    def sample(params, stats, keys, observation, told):
        p = jnp.broadcast_to(told.p_world_trocar[:, None], (len(keys), 4, 1, 3))
        return Command(Pose(jnp.broadcast_to(jnp.eye(3), (*p.shape, 3)), p), p[..., 0])

    base = counting()

    def reset(key, params):
        state = base.reset(key, params)
        told = rcm.trocar_frame(rcm.Trocar(*np.float32([[0.03], [1.5], [0.2]])), base.p_world_ref)
        return state.replace(measured_trocar=told)

    expected = rcm.trocar_position(rcm.Trocar(0.03, 1.5, 0.2), base.p_world_ref[0])
    for episode in run(base._replace(reset=reset), agent.from_policy(sample, 1, 4), max_steps=3):
        np.testing.assert_allclose(episode.joined("reached_qpos")[0, :3], expected, atol=1e-7)


@pytest.mark.parametrize(
    ("obs_horizon", "execute", "argument"),
    [(6, 4, "obs_horizon"), (0, 4, "obs_horizon, execute"), (1, 0, "obs_horizon, execute")],
)
def test_horizons_that_cannot_be_are_named(obs_horizon, execute, argument):
    with pytest.raises(errors.UsageError) as raised:
        agent.from_policy(spy(6), obs_horizon, execute)
    assert raised.value.argument == argument


def test_no_more_commands_are_executed_than_planned():
    with pytest.raises(errors.UsageError) as raised:
        run(counting(), agent.from_policy(spy(6), 2, 7))
    assert raised.value.argument == "execute" and "6" in raised.value.expected


@pytest.mark.parametrize("arms", [1, 2])
def test_a_replayed_episode_is_the_recorded_one(arms):
    """From an expert whose commands are executed as recorded."""
    env = stubs.make_env(arms=arms, unlucky=0.0)
    expert = agent.from_single(stubs.EXPERT)
    trocars = stubs.trocars(11, arms=arms)
    settings = engine.RolloutSettings(0, None, 60, 1)

    def first(batch_agent):
        simulate = engine.make(env, batch_agent, trocars, settings, episodes.DEMONSTRATION)
        return next(e for s in simulate(None, [(0, 0)]) for e in s.ended)

    before = first(expert)
    command = Command(
        Pose(before.joined("command_R"), before.joined("command_p")),
        before.joined("command_gripper"),
    )
    after = first(agent.from_single(agent.replay(command)))
    assert after.outcome == before.outcome and before.outcome["success"]
    for name in before.arrays:
        np.testing.assert_array_equal(after.joined(name), before.joined(name), name)


def test_the_commanded_error_is_that_of_the_executed_command():
    """At step t the command misses the trocar by 20 mm less 1 mm for each step from the sixth."""

    def sample(params, stats, keys, observation, told):
        t = observation.gripper[:, -1:] + jnp.arange(6.0)[:, None]
        aside = 0.02 - 0.001 * jnp.abs(t - 5.0)
        R = jnp.broadcast_to(jnp.eye(3), (*t.shape, 3, 3))
        return Command(Pose(R, aside[..., None] * jnp.array([1.0, 0.0, 0.0])), t)

    for episode in run(counting(), agent.from_policy(sample, 2, 4), max_steps=10):
        error = episode.joined("rcm_error_commanded")[:, 0]
        np.testing.assert_allclose(error, 0.02 - 0.001 * abs(np.arange(10) - 5.0), rtol=1e-5)


def test_each_program_is_traced_once():
    traces = []
    sample, params = stubs.make_policy(width=32)

    def counted(*args):
        traces.append(1)
        return sample(*args)

    env = stubs.make_env()
    settings = engine.RolloutSettings(0, None, 450, 2)
    policy = agent.from_policy(counted, 2, 4)
    simulate = engine.make(env, policy, CENTRE, settings, episodes.SCORE)
    for group in ([(0, 0), (0, 1)], [(0, 2)]):
        assert len(list(simulate((params, jnp.float32(0.0)), group))) >= 1
    assert len(traces) == 1
