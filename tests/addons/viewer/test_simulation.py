"""The live loop: an evaluation's episodes while undisturbed, and trocars that move."""

import types

import fakes
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stubs

from starjax import rcm
from starjax.addons.viewer import episode_alarm, simulation
from starjax.addons.viewer.frame import outcome
from starjax.core.types import Command
from starjax.evaluation import alarms
from starjax.policies.monitor import record, scores
from starjax.sim import arm_motion, ik, moving_trocars, registries, wrist_motion
from starjax.sim import scene as scenes
from starjax.sim.rollouts import agent, engine, episodes, plans


def stubbed():
    """The point masses, with the scene fields that the page shows."""
    env = stubs.make_env(unlucky=0.0)
    nothing = types.SimpleNamespace(bound=None, geom_rgb=np.zeros((1, 3)), arms=())
    task = env.task._replace(colours=lambda bound, layout, rgb: rgb)
    return env._replace(scene=nothing, task=task)


@pytest.mark.parametrize("who", ["expert", "policy"])
def test_undisturbed_it_is_the_episode_of_an_evaluation(who):
    env, seed, trial = stubbed(), 5, (3, 2)
    sample, params = stubs.make_policy()
    acting = {
        "expert": (agent.from_single(stubs.EXPERT), None),
        "policy": (agent.from_policy(sample, 2, 4), (params, 1.0)),
    }
    batch, params = acting[who]
    trocars = env.task.trocars
    run = engine.make(
        env, batch, trocars, engine.RolloutSettings(seed, None, 60, lanes=1), episodes.SCORE
    )
    (progress,) = [p for p in run(params, [trial]) if p.ended]
    expected = progress.ended[0].joined("reached_p")
    live = simulation.make(who, env, batch, params)
    carry, frame = live.start(seed, *trial)
    for t, p in enumerate(expected):
        carry, frame = live.step(carry, frame.p_world_trocar)
        np.testing.assert_allclose(frame.p_world_tip, p, rtol=0, atol=1e-6)
        assert frame.step == t + 1
    assert bool(frame.success) == progress.ended[0].outcome["success"]


def test_a_plan_is_shown_from_its_next_command_on():
    env = stubbed()
    sample, params = stubs.make_policy(horizon=6)
    live = simulation.make("policy", env, agent.from_policy(sample, 2, 4), (params, 0.0))
    carry, frame = live.start(0, 0, 0)
    for _ in range(6):
        carry, frame = live.step(carry, frame.p_world_trocar)
        ahead = carry.memory.command.pose.p[0, (int(frame.step) - 1) % 4 + 1]
        np.testing.assert_array_equal(frame.plan[0], ahead)
        assert frame.plan.shape == (6, 1, 3)


def test_what_stays_keeps_its_bits_and_what_moves_is_told(env):
    state = jax.eval_shape(
        lambda: env.reset(
            jax.random.key(0), simulation.sim_env.EnvParams(rcm.Trocar(*[[0.02]] * 3))
        )
    )
    frame = rcm.trocar_frame(
        rcm.Trocar(*np.float32([[0.04], [1.4], [0.3]])), env.p_world_ref, np.zeros(1)
    )
    state = state.replace(trocar=frame, measured_trocar=frame)
    same = moving_trocars.move_trocars(env, state, frame.p_world_trocar)
    jax.tree.map(np.testing.assert_array_equal, same.trocar, frame)
    place = np.float32([[0.01, -0.02, 0.152]])
    other = moving_trocars.move_trocars(env, state, place)
    for measured_trocar in (other.trocar, other.measured_trocar):
        np.testing.assert_allclose(measured_trocar.p_world_trocar, place, atol=1e-7)
        np.testing.assert_allclose(
            rcm.trocar_position(measured_trocar.trocar, env.p_world_ref), place, atol=1e-7
        )


def test_what_was_planned_is_carried_to_where_the_trocar_is():
    random = np.random.default_rng(0)
    before, now = np.float32(0.02 * random.normal(size=(2, 50, 1, 3)) + [0, 0, 0.15])
    action = np.float32(random.normal(size=(50, 1, 4)) * [1, 0.03, 0.03, 0.02] + [0, 0, 0, 0.03])
    place = rcm.trocar_from_position(before, [0.0, 0.0, 0.15])
    pose, _ = rcm.ACTION_SPACES["rcm4"].decode(action, place, [0.0, 0.0, 0.15])
    command = Command(pose, np.ones((50, 1), np.float32))
    found = moving_trocars.carried(fakes.TASK, command, before, now)
    assert np.max(rcm.rcm_error(found.pose, now)) < 1e-6
    np.testing.assert_array_equal(found.pose.p, pose.p)
    stays = moving_trocars.carried(fakes.TASK, command, before, before)
    np.testing.assert_array_equal(stays.pose.R, pose.R)
    missed = command._replace(pose=pose._replace(p=pose.p + np.float32([0.0, 0.001, 0.001])))
    free = np.asarray(rcm.rcm_error(missed.pose, before)) > moving_trocars.HELD
    left = moving_trocars.carried(fakes.TASK, missed, before, now).pose
    np.testing.assert_array_equal(left.R[free], missed.pose.R[free])
    assert free.sum() > 40


def test_a_planned_wrist_is_bent_anew_and_its_tip_stays():
    random, wrist = np.random.default_rng(0), rcm.LARGE_NEEDLE_DRIVER
    task = registries.tasks.get("needle_drive")
    before, now = np.float32(0.02 * random.normal(size=(2, 50, 1, 3)) + [0, 0, 0.15])
    tip = rcm.Pose(np.float32(np.diag([1, -1, -1])), np.float32([0, 0, 0.01]))
    found = rcm.through(wrist, tip, before)
    command = Command(found.pose, np.ones((50, 1), np.float32), found.wrist)
    moved = moving_trocars.carried(task, command, before, now)
    shafts = rcm.shaft_of(wrist, moved.pose, moved.wrist)
    assert np.max(rcm.rcm_error(shafts, now)) < 1e-6
    np.testing.assert_allclose(moved.pose.p, command.pose.p, atol=1e-6)
    np.testing.assert_allclose(moved.pose.R, command.pose.R, atol=1e-5)
    stays = moving_trocars.carried(task, command, before, before)
    jax.tree.map(np.testing.assert_array_equal, stays, command)
    free = command._replace(wrist=command.wrist + 0.1)
    jax.tree.map(
        np.testing.assert_array_equal, moving_trocars.carried(task, free, before, now), free
    )


def test_the_tip_of_a_mechanical_remote_centre_stays_where_its_trocar_moves():
    env = simulation.sim_env.make("needle_drive", observation="state")
    (bound,) = env.scene.arms
    before, now = np.float32([[[0.01, 0.0, 0.15]], [[0.0105, -0.0005, 0.1502]]])
    tip = rcm.Pose(np.float32(np.diag([1, -1, -1])), np.float32([0.005, 0.0, 0.01]))
    place = jax.eval_shape(
        lambda: env.reset(jax.random.key(0), simulation.sim_env.EnvParams(rcm.Trocar(*[[0.0]] * 3)))
    )

    @jax.jit
    def moved():
        shaft, angles = wrist_motion.carried(bound.tool.wrist, tip, before[0])
        q, _ = arm_motion.solve(bound, before[0], shaft, None, 30)
        q = jnp.concatenate([q, angles])
        frame = moving_trocars.frame_at(env, before)
        qpos = jnp.zeros(place.physics.qpos.shape).at[bound.q].set(q)
        state = place.replace(
            trocar=frame,
            measured_trocar=frame,
            pose=jax.tree.map(lambda leaf: leaf[None], tip),
            physics=place.physics.replace(qpos=qpos),
            q_target=(q,),
        )
        return [moving_trocars.move_trocars(env, state, p).physics.qpos for p in (before, now)]

    same, after = moved()
    for qpos, p in ((same, before), (after, now)):
        chain = scenes.chain_at(bound, p[0])
        found = arm_motion.tip_of(bound, ik.forward(chain, qpos[bound.q])[0], qpos[bound.q])
        np.testing.assert_allclose(found.p, tip.p, atol=5e-6)
        np.testing.assert_allclose(found.R, tip.R, atol=1e-4)
    assert np.abs(after - same).max() > 1e-4


def test_a_dragged_trocar_is_followed_and_the_task_is_done_through_it(expert):
    carry, frame = expert.start(0, 0, 0)
    target = frame.p_world_trocar + np.float32([[-0.03, 0.02, 0.0]])
    errors, speed = [], []
    while not outcome(frame) and frame.step < 300:
        before = frame.p_world_trocar
        carry, frame = expert.step(carry, target)
        errors.append(float(frame.rcm_error[0]))
        speed.append(float(np.linalg.norm(frame.p_world_trocar - before)) * 30)
    assert outcome(frame) == "success" and not frame.collided
    np.testing.assert_allclose(frame.p_world_trocar, target, atol=1e-6)
    assert max(speed) < 1.001 * simulation.TROCAR_SPEED
    assert max(errors) < 5e-3 and errors[-1] < 1e-4  # it lags behind the hand, and arrives


ALARM_SETTINGS = scores.ScoreSettings(4, 30.0, 2)


def test_a_live_episode_has_the_alarm_of_its_evaluation():
    env = stubbed()
    sample, params = stubs.make_policy(horizon=6)
    batch, params = agent.from_policy(sample, 2, 4), (params, 1.0)
    rules = engine.RolloutSettings(5, None, 60, lanes=1)
    run = engine.make(env, batch, env.task.trocars, rules, plans.record(4))
    (episode,) = [e for p in run(params, [(3, 2)]) for e in p.ended]
    values = alarms.of_episodes([episode], ALARM_SETTINGS, 60)
    limit = np.nanmax(values[0, :4, 0]) * 0.999
    width = np.array([1.0, 1e9, 1e9, 1e9, 1e9, 1e9])
    monitor = record.Monitor(np.zeros(6), width, limit, 1.0, 0.05, 20, ALARM_SETTINGS, "")
    times, _ = record.first_alarms(monitor, values)
    for watched, text in ((None, ""), (monitor, f"alarm at {times[0]:.1f} s: disagreement")):
        live = simulation.make("policy", env, batch, params)
        alarm = episode_alarm.EpisodeAlarm(watched)
        carry, frame = live.start(5, 3, 2)
        for _ in range(13):
            before = frame
            carry, frame = live.step(carry, frame.p_world_trocar)
            alarm.update(before, carry)
        assert alarm.text.startswith(text) and bool(alarm.text) == bool(text)
    alarm.reset()
    assert alarm.text == ""
