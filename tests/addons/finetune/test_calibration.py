"""Laws of the conformal threshold, on synthetic trials of unequal length."""

import math

import numpy as np
import pytest
import scipy.stats

from starjax.addons.finetune import calibration
from starjax.core import errors
from starjax.policies.monitor import record, scores

SETTINGS = scores.ScoreSettings(execute=8, control_hz=30.0, still=6)
S, CLOCK = len(scores.NAMES), scores.NAMES.index("clock")
UNITS = np.array([1e-3, 5.0, 0.1, 1e-3, 0.5])  # limits of the scores without the clock


def trials(rng: np.random.Generator, count: int, longest: int = 30) -> np.ndarray:
    """Scores `[count, longest, S]`, dependent in time, of trials that end anywhere."""
    walks = rng.normal(size=(count, longest, S - 1)).cumsum(axis=1) * UNITS
    clock = np.broadcast_to(np.arange(longest) * SETTINGS.period_s, (count, longest))
    values = np.insert(walks, CLOCK, clock, axis=-1)
    values[:, : SETTINGS.still, 1] = np.nan
    length = rng.integers(2, longest + 1, count)
    values[np.arange(longest) >= length[:, None]] = np.nan
    return values


def made(rng: np.random.Generator, alpha: float = 0.05, count: int = 400) -> record.Monitor:
    return calibration.calibrate(trials(rng, 200), trials(rng, count), alpha, SETTINGS, "weights")


@pytest.mark.parametrize("alpha", [0.02, 0.05, 0.2])
def test_the_false_alarm_rate_is_within_its_interval(alpha):
    rng = np.random.default_rng(1)
    rates = []
    for _ in range(40):
        times, _ = record.first_alarms(made(rng, alpha, 199), trials(rng, 200))
        rates.append(np.isfinite(times).mean())
    alarms = round(sum(rates) * 200)
    # Given the calibration set the rate follows a beta distribution (Vovk, 2012).
    rank = math.ceil(200 * (1 - alpha) - 1e-9)
    deviation = scipy.stats.beta(200 - rank, rank).std() / math.sqrt(40)
    binomial = math.sqrt(alpha * (1 - alpha) / 8000)
    assert abs(alarms / 8000 - alpha) < 4 * math.hypot(deviation, binomial)


@pytest.mark.parametrize("count", [19, 20, 39, 100])
def test_the_rank_is_exact_over_all_choices_of_the_new_trial(count):
    values, alpha = np.random.default_rng(count).normal(size=count + 1), 0.05
    over = [
        values[i] > calibration.threshold(np.delete(values, i), alpha) for i in range(count + 1)
    ]
    assert sum(over) == math.floor((count + 1) * alpha + 1e-9)


def test_too_few_successes_give_no_threshold():
    assert calibration.required(0.05) == 19
    assert calibration.threshold(np.arange(18.0), 0.05) == math.inf
    assert calibration.threshold(np.arange(19.0), 0.05) == 18.0
    rng = np.random.default_rng(0)
    with pytest.raises(errors.UsageError):
        made(rng, 0.05, 18)


def test_a_larger_alpha_never_raises_the_threshold():
    values = np.random.default_rng(2).normal(size=500)
    limits = [calibration.threshold(values, alpha) for alpha in np.linspace(0.01, 0.9, 50)]
    assert (np.diff(limits) <= 0).all()


def test_bands_are_one_sided():
    rng = np.random.default_rng(3)
    monitor, fresh = made(rng), trials(rng, 300)
    before, _ = record.first_alarms(monitor, fresh)
    lower, _ = record.first_alarms(monitor, fresh - 1e6)
    assert np.isinf(lower).all()
    higher, _ = record.first_alarms(monitor, fresh + np.insert(UNITS, CLOCK, 0.0))
    assert (higher <= before).all()


def test_units_do_not_matter():
    first, second, fresh = (trials(np.random.default_rng(i), 300) for i in range(3))
    unit, zero = np.array([1e3, 0.2, 1.0, 3.0, 0.5, 7.0]), np.array([5.0, -2.0, 0, 1, 4, -3])
    one = calibration.calibrate(first, second, 0.05, SETTINGS)
    two = calibration.calibrate(unit * first + zero, unit * second + zero, 0.05, SETTINGS)
    for a, b in zip(record.first_alarms(one, fresh), record.first_alarms(two, unit * fresh + zero)):
        np.testing.assert_array_equal(a, b)


def test_nan_neither_alarms_nor_hides_another_score():
    monitor = made(np.random.default_rng(4))
    blank = np.full((1, 5, S), np.nan)
    assert np.isinf(record.first_alarms(monitor, blank)[0]).all()
    for name in scores.CALIBRATED:
        score = scores.NAMES.index(name)
        limit = monitor.limits[score]
        over = blank.copy()
        over[0, 3, score] = limit + monitor.width[score]
        time, which = record.first_alarms(monitor, over)
        assert time == pytest.approx(3 * SETTINGS.period_s)
        assert which == score
    assert calibration.maxima(blank, monitor.center, monitor.width) == -np.inf


def test_an_undefined_score_leaves_the_others():
    def undefined(seed):
        values = trials(np.random.default_rng(seed), 300)
        values[..., 0] = np.nan
        return values

    monitor = calibration.calibrate(undefined(5), undefined(6), 0.05, SETTINGS)
    rate = np.isfinite(record.first_alarms(monitor, undefined(7))[0]).mean()
    assert 0.01 < rate < 0.12


def test_the_clock_alone_is_a_quantile_of_durations():
    durations = np.arange(1, 101)
    values = np.full((100, 100, S), np.nan)
    for trial, length in enumerate(durations):
        values[trial, :length, 2] = np.arange(length)
    monitor = calibration.calibrate(values, values, 0.05, SETTINGS)
    assert monitor.clock_s == 95.0  # the 96th of 0 to 99


def test_json_round_trip_and_refusals():
    monitor = made(np.random.default_rng(8))
    values = record.to_json(monitor)
    again = record.from_json(values)
    np.testing.assert_array_equal(again.limits, monitor.limits)
    assert again[2:] == monitor[2:]
    unknown = ["clock", "temper"]
    for change in (
        {"scores": unknown}, {"scores": ["clock", "stillness"]}, {"width": [1.0]},
        {"width": [0.0] * len(scores.CALIBRATED)}, {"count": None},
    ):  # fmt: skip
        broken = {**values, **change}
        if broken["count"] is None:
            del broken["count"]
        with pytest.raises(ValueError):
            record.from_json(broken)


def test_a_monitor_of_other_scores_alarms_on_these_alone():
    rng = np.random.default_rng(9)
    center, width = calibration.fit(trials(rng, 200))
    names = ["disagreement", "stillness", "clock"]  # names of the first version
    values = record.to_json(made(rng)) | {"scores": names, "threshold": 0.0}
    values |= {"center": center[:3].tolist(), "width": width[:3].tolist()}
    found = record.from_json(values)
    assert record.to_json(found) == values
    fresh = trials(np.random.default_rng(10), 300)
    times, score = record.first_alarms(found, fresh)
    assert set(score[np.isfinite(times)]) <= {0, 1, 2} and np.isfinite(times).mean() > 0.05
    loud = fresh.copy()
    loud[..., 3:] = 1e9
    np.testing.assert_array_equal(record.first_alarms(found, loud)[0], times)


def test_a_new_monitor_alarms_on_the_scores_that_delays_leave_alone():
    monitor = made(np.random.default_rng(11))
    assert record.to_json(monitor)["scores"] == list(scores.CALIBRATED)
    loud = trials(np.random.default_rng(12), 100)
    times, _ = record.first_alarms(monitor, loud)
    for name in set(scores.NAMES) - set(scores.CALIBRATED):
        loud[..., scores.NAMES.index(name)] = 1e9
    np.testing.assert_array_equal(record.first_alarms(monitor, loud)[0], times)
