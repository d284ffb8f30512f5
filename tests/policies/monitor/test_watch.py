"""Scores of plans and tips by hand, and the monitor of one episode against that of a recording."""

import numpy as np
import pytest

from starjax.policies.monitor import record, scores, watch

SETTINGS = scores.ScoreSettings(execute=8, control_hz=30.0, still=6)
HORIZON, S = 16, len(scores.NAMES)


def plans(rng: np.random.Generator, decisions: int, arms: int = 1) -> np.ndarray:
    """Plans `[D, H, A, 3]` around one path, each with an error of its own."""
    steps = HORIZON + SETTINGS.execute * decisions
    path = rng.normal(size=(steps, arms, 3)).cumsum(axis=0) * 1e-3
    first = SETTINGS.execute * np.arange(decisions)
    error = rng.normal(size=(decisions, HORIZON, arms, 3)) * 1e-3
    return np.stack([path[start : start + HORIZON] for start in first]) + error


def recorded(made: np.ndarray, steps: int) -> tuple[np.ndarray, np.ndarray]:
    t = np.arange(steps)
    decision, index = np.divmod(t, SETTINGS.execute)
    return made[decision, index], made[decision, index + SETTINGS.execute]


def monitor(**fields) -> record.Monitor:
    default = {
        "center": np.zeros(S), "width": np.ones(S), "threshold": np.inf, "clock_s": 1.0,
        "alpha": 0.05, "count": 100, "settings": SETTINGS, "digest": "",
    }  # fmt: skip
    return record.Monitor(**{**default, **fields})


def test_equal_plans_do_not_disagree_and_a_shift_is_its_length():
    plan = np.zeros((HORIZON, 1, 3))
    plan[:, 0, 0] = np.arange(HORIZON)
    later = plan + np.array([8.0, 0.0, 0.0])
    assert scores.gap(plan, later, 8, 8) == 0.0
    assert scores.gap(plan, later + np.array([0.0, 3.0, 4.0]), 8, 8) == pytest.approx(5.0)
    assert scores.gap(plan, later, 14, 8) == pytest.approx(6.0)
    assert np.isnan(scores.gap(plan, later, HORIZON, 8))


def test_the_arm_that_disagrees_most_moves_most_or_closes_most_counts():
    plan = np.zeros((HORIZON, 2, 3))
    assert scores.gap(
        plan, plan + np.eye(3)[[0, 0]] * np.array([[0.0], [1.0]]), 8, 8
    ) == pytest.approx(1.0)
    tips = np.zeros((20, 2, 3))
    tips[:, 1, 0] = np.arange(20)
    openings = np.stack([np.linspace(1, -1, 20), np.zeros(20)], -1)
    zeros = np.zeros(20)
    rows = scores.series(zeros, zeros, tips, openings, np.arange(20.0), zeros, 6)
    assert np.isnan(rows[:6, 1]).all()
    np.testing.assert_allclose(rows[6:, 1], -6.0)
    assert np.isnan(rows[:2, 0]).all()
    np.testing.assert_allclose(rows[:, 2], np.arange(20.0))
    np.testing.assert_allclose(rows[[0, 9, 10, 19], 3], [0, 0, 1 / 19, 1], atol=1e-12)


@pytest.mark.parametrize("arms", [1, 2])
def test_a_watch_equals_the_scores_of_a_recording(arms):
    rng = np.random.default_rng(arms)
    decisions = 20
    made, steps = plans(rng, decisions, arms), 8 * decisions
    tip = rng.normal(size=(steps, arms, 3)).cumsum(axis=0) * 1e-3
    opening = rng.uniform(-1, 1, (steps, arms))
    whole = scores.of_trial(*recorded(made, steps), tip, opening, SETTINGS)
    assert whole.shape == (decisions, S)
    live = watch.Watch(monitor())
    for decision in range(decisions):
        plan, measured = made[decision], tip[8 * decision]
        inputs = ((x[..., 0, :] if arms == 1 else x) for x in (plan, measured))
        assert live.update(*inputs, gripper=opening[8 * decision].squeeze()) is None
        np.testing.assert_allclose(live.scores, whole[decision], rtol=1e-12)


def test_plans_without_a_common_step_have_no_disagreement():
    planned = np.zeros((64, 1, 3))
    rows = scores.of_trial(
        planned, np.full((64, 1, 3), np.nan), planned, np.ones((64, 1)), SETTINGS
    )
    assert np.isnan(rows[:, 0]).all()
    assert np.isfinite(rows[6:, 1:]).all()


@pytest.mark.parametrize("steps", [1, 7, 8, 9, 50, 64])
def test_trials_of_any_length_have_a_row_per_decision(steps):
    rows = scores.of_trial(*np.zeros((3, steps, 1, 3)), np.zeros((steps, 1)), SETTINGS)
    assert rows.shape == (-(-steps // 8), S)


def test_an_alarm_says_which_score_its_value_and_its_threshold():
    far = np.zeros((HORIZON, 3))
    live = watch.Watch(monitor(threshold=0.5, width=np.array([0.01, 0.01, 1e9, 1.0, 0.1, 1e9])))
    alarm = None
    for i in range(10):
        alarm = alarm or live.update(far + 0.1 * i, i * np.ones(3))
    assert alarm is not None
    assert (alarm.score, alarm.threshold) == ("disagreement", pytest.approx(0.005))
    assert alarm.value == pytest.approx(0.1 * np.sqrt(3))
    assert alarm.time_s == pytest.approx(3 * 8 / 30)
    assert "disagreement" in str(alarm)


def test_holds_do_not_count_and_reset_begins_anew():
    live = watch.Watch(monitor())
    plan = np.zeros((HORIZON, 3))
    live.update(plan, np.zeros(3))
    live.update(plan, np.zeros(3), steps=3)
    assert live.scores[2] == pytest.approx(0.1)
    live.reset()
    live.update(plan, np.zeros(3), steps=3)
    assert live.scores[2] == 0.0


def test_late_plans_do_not_conflict_and_advance_less():
    """A path at 1 mm per control step; with a delay each plan begins four steps back."""
    path = np.zeros((400, 1, 3))
    path[:, 0, 0] = 1e-3 * np.arange(400)
    for late in (0, 4):
        starts = (SETTINGS.execute - late) * np.arange(20)
        made = np.stack([path[start : start + HORIZON] for start in starts])
        planned, ahead = recorded(made, 8 * 20)
        rows = scores.of_trial(planned, ahead, planned, np.ones((160, 1)), SETTINGS)
        np.testing.assert_allclose(rows[3:, 0], late * 1e-3, atol=1e-9)
        np.testing.assert_allclose(rows[3:, 4], 0, atol=1e-9)
        np.testing.assert_allclose(rows[:, 5], starts / 30.0)
        np.testing.assert_allclose(rows[:, 2], 8 * np.arange(20) / 30.0)


def test_plans_of_a_tip_at_rest_advance_as_the_clock():
    made = np.random.default_rng(5).normal(size=(20, HORIZON, 1, 3)) * 1e-5
    planned, ahead = recorded(made, 160)
    rows = scores.of_trial(planned, ahead, planned, np.ones((160, 1)), SETTINGS)
    np.testing.assert_allclose(rows[:, 5], rows[:, 2])


def test_a_plan_of_another_aim_conflicts_at_every_shift():
    path = np.zeros((HORIZON, 1, 3))
    path[:, 0, 0] = 1e-3 * np.arange(HORIZON)
    other = path + np.array([0.0, 0.02, 0.0])
    found = scores.overlap(path, other, 8, 8)
    assert found.conflict == pytest.approx(0.02) and found.gap > found.conflict
