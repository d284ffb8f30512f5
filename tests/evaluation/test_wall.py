"""A spring and a damper between port and shaft."""

import numpy as np

from starjax.evaluation import trials, wall


def table(*errors_mm):
    """Trials with these executed RCM errors, `[T]` mm each."""
    blank = dict.fromkeys(trials.Table._fields)
    return trials.Table(
        **{
            **blank,
            "steps": np.array([len(error) for error in errors_mm], np.int32),
            "rcm_error_mm": np.concatenate(errors_mm).astype(np.float16),
        }
    )


def test_a_shaft_that_rests_off_its_port_is_held_by_the_spring_alone():
    found = wall.force(table(np.full(50, 2.0), np.full(10, 2.0)), 30.0)
    np.testing.assert_allclose([found["mean"], found["max"]], 2e-3 * wall.STIFFNESS, rtol=1e-3)


def test_one_that_moves_away_feels_the_damper_and_trials_do_not_mix():
    ramp = 0.25 * np.arange(40)
    found = wall.force(table(ramp, np.zeros(60)), 30.0)
    most = 1e-3 * (wall.STIFFNESS * ramp[-1] + wall.DAMPING * 0.25 * 30.0)
    np.testing.assert_allclose(found["max"], most, rtol=1e-3)
    assert wall.force(table(ramp), 30.0)["max"] == found["max"]


def test_nothing_moved_is_no_force():
    assert wall.force(table(np.zeros(0)), 30.0)["max"] is None
