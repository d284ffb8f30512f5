"""Laws of the ways to make a monitor that benchmarks/monitor_choice.py compares."""

import types

import numpy as np
import pytest

from starjax.policies.monitor import record, scores

SETTINGS = scores.ScoreSettings(execute=8, control_hz=30.0, still=3)
STILLNESS, CLOSURE, PROGRESS = map(scores.NAMES.index, ("stillness", "closure", "progress"))
COUNT, LONGEST = 24, 40


@pytest.fixture
def choice(monkeypatch, pytestconfig):
    monkeypatch.syspath_prepend(pytestconfig.rootpath / "benchmarks")
    import monitor_choice

    return monitor_choice


def table(rng, count=COUNT):
    values = rng.normal(size=(count, LONGEST, len(scores.NAMES)))
    clock = np.arange(LONGEST) * SETTINGS.period_s
    values[..., scores.NAMES.index("clock")] = values[..., PROGRESS] = clock
    return types.SimpleNamespace(success=np.ones(count, bool), scores=values)


def test_a_path_by_progress_is_that_of_a_trial_without_delay(choice):
    values = table(np.random.default_rng(0)).scores
    same = choice.by_progress(values, SETTINGS)
    np.testing.assert_allclose(same[:, SETTINGS.still :], values[:, SETTINGS.still :])
    slow = values.copy()
    slow[..., PROGRESS] /= 2
    slow[..., STILLNESS] /= 2  # half the path in a window
    np.testing.assert_allclose(
        choice.by_progress(slow, SETTINGS)[..., STILLNESS], same[..., STILLNESS]
    )


def test_jaws_that_open_again_are_not_held(choice):
    values = np.full((1, 8, len(scores.NAMES)), -1.0)
    values[0, 2:4, CLOSURE] = 1.0
    assert np.nanmax(choice.held(values, SETTINGS)[..., CLOSURE]) == -1.0
    values[0, 4, CLOSURE] = 1.0
    held = choice.held(values, SETTINGS)[0, :, CLOSURE]
    assert np.flatnonzero(held == 1.0).tolist() == [4]


def test_the_halves_share_no_trocar(choice):
    labels = {"camera 2 mm": types.SimpleNamespace(success=np.zeros(36, bool), at=np.arange(36))}
    first, second = (choice.halved(labels, is_test=x)["camera 2 mm"].at // 3 for x in (False, True))
    assert first.tolist() == np.repeat(range(0, 12, 2), 3).tolist()
    assert second.tolist() == np.repeat(range(1, 12, 2), 3).tolist()


def test_levels_of_scores_raise_no_more_than_their_sum(choice):
    rng = np.random.default_rng(1)
    monitor = choice.by_score(table(rng, 800), 0.1, SETTINGS, "weights", scores.CALIBRATED)
    times, _ = record.first_alarms(monitor, table(rng, 2000).scores)
    assert 0.03 < np.isfinite(times).mean() < 0.1
