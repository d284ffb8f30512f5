"""Scores that an evaluation records, and the figures of alarms, by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stubs

from starjax.evaluation import alarms, evaluate
from starjax.evaluation import trials as tables
from starjax.policies.monitor import record, scores, watch
from starjax.sim.rollouts import agent, engine, episodes, plans

EXECUTE, HORIZON = 4, 6
SETTINGS = scores.ScoreSettings(execute=EXECUTE, control_hz=30.0, still=2)
TROCARS = stubs.trocars(0, 4, 8)


def run(directory, score_settings=SETTINGS, **changed):
    sample, weights = stubs.make_policy(HORIZON, width=32)
    settings = evaluate.EvaluationSettings(trials=2, seed=0, time_limit_s=1.0)
    return evaluate.evaluate(
        directory,
        stubs.make_env(),
        agent.from_policy(sample, 2, EXECUTE),
        (weights, jnp.float32(1.0)),
        TROCARS,
        settings._replace(**changed),
        layout=evaluate.DeviceLayout(6, None),
        score_settings=score_settings,
        report=lambda _: None,
    )


def monitor(threshold=np.inf, clock_s=0.5):
    return record.Monitor(
        np.zeros(len(scores.NAMES)),
        np.ones(len(scores.NAMES)),
        threshold,
        clock_s,
        0.05,
        100,
        SETTINGS,
        "weights",
    )


def test_recorded_plans_are_those_that_a_watch_would_meet():
    """Scores from records of single control steps equal those from whole plans."""
    sample, weights = stubs.make_policy(HORIZON, width=32)
    met = []

    def spied(*inputs):
        command = sample(*inputs)
        jax.debug.callback(lambda p: met.append(np.array(p[0])), command.pose.p)
        return command

    batch = agent.from_policy(spied, 2, EXECUTE)
    env = stubs.make_env(unlucky=0.0)
    simulate = engine.make(
        env, batch, TROCARS, engine.RolloutSettings(0, None, 28, 1), plans.record(EXECUTE)
    )
    params = (weights, jnp.float32(1.0))
    (episode,) = (e for s in simulate(params, [(0, 0)]) for e in s.ended)
    found = alarms.of_episodes([episode], SETTINGS, 28)[0]
    jax.effects_barrier()
    live = watch.Watch(monitor())
    measured = episode.joined(plans.MEASURED)[::EXECUTE]
    assert len(met) == len(measured) >= 4
    opening = episode.joined(plans.OPENING)[::EXECUTE]
    for row, plan, tip, gripper in zip(
        found[:-1], met, measured, opening
    ):  # the last plan may be cut off
        live.update(plan, tip, gripper=gripper)
        np.testing.assert_allclose(row, live.scores, rtol=1e-4, atol=1e-7)
    assert np.isfinite(found[3]).all()


def test_scores_change_no_trial_and_survive_a_restart(tmp_path):
    plain, scored = run(tmp_path / "plain", None), run(tmp_path / "scored")
    assert plain.scores is None
    ours, theirs = tables.columns(scored), tables.columns(plain)
    assert ours.keys() - theirs.keys() == {"scores"}
    for name, column in theirs.items():
        np.testing.assert_array_equal(ours[name], column, name)
    assert scored.scores.shape == (6, -(-30 // EXECUTE), len(scores.NAMES))
    ends = np.isfinite(scored.scores[..., 2]).sum(axis=1)
    np.testing.assert_array_equal(ends, -(-scored.steps // EXECUTE))
    again = run(tmp_path / "scored", chunk=2)
    np.testing.assert_array_equal(again.scores, scored.scores)
    rows = scored.trial == 0
    np.testing.assert_array_equal(tables.select(scored, rows).scores, scored.scores[rows])
    other = run(tmp_path / "scored", SETTINGS._replace(still=1))
    assert not np.array_equal(other.scores, scored.scores, equal_nan=True)


def test_figures_by_hand(tmp_path):
    table = run(tmp_path)
    values = np.full((6, 8, len(scores.NAMES)), np.nan, np.float32)
    values[..., 2] = 0.0
    success = np.array([1, 1, 1, 0, 0, 0], bool)
    values[0, 2, 0] = 2.0  # a false alarm
    values[3, 1, 1] = 2.0  # at 4/30 s
    values[4, 7, 0] = 2.0  # at 28/30 s, after the clock's
    table = table._replace(success=success, scores=values)
    found = alarms.compose(table, monitor(threshold=1.0))
    assert (found["announced"]["successes"], found["announced"]["trials"]) == (2, 3)
    assert found["before_clock"]["successes"] == 1
    assert (found["false_alarms"]["successes"], found["false_alarms"]["trials"]) == (1, 3)
    assert (found["silent"]["successes"], found["silent"]["trials"]) == (2, 3)
    assert found["median_s"] == pytest.approx(16 / 30)
    none = dict.fromkeys(scores.NAMES, 0)
    assert found["by_score"] == none | {"disagreement": 1, "stillness": 1}
    silent = alarms.compose(table, monitor())
    assert silent["median_s"] is None and silent["silent"]["trials"] == 6


def test_no_common_steps_leave_the_disagreement_undefined():
    fields = plans.record(HORIZON).fields
    pose = stubs.Pose(jnp.eye(3)[None, None], jnp.zeros((1, 1, 3)))
    plan = stubs.Pose(jnp.zeros((1, HORIZON, 1, 3, 3)), jnp.ones((1, HORIZON, 1, 3)))
    state = stubs.make_env().reset(jax.random.key(0), engine_params())
    batch = jax.tree.map(lambda x: jnp.asarray(x)[None], state)
    memory = agent.Plan(None, None, stubs.Command(plan, jnp.ones((1, HORIZON, 1))))
    command = stubs.Command(pose, jnp.ones((1, 1)))
    found = fields(episodes.Step(None, command, command, batch, batch, memory))
    assert np.isnan(found[plans.AHEAD]).all()
    np.testing.assert_array_equal(found[plans.PLANNED], 1.0)


def engine_params():
    from starjax.sim.env import EnvParams

    return EnvParams(jax.tree.map(lambda x: x[0], TROCARS))
