"""Figures of an evaluation against textbook values and against simulation."""

import json

import numpy as np
import pytest

from starjax.evaluation import statistics
from starjax.evaluation import trials as table


def trials(success, trocar=None, **columns):
    count = len(success)
    zeros = np.zeros(count, np.float32)
    base = dict.fromkeys(table.Table._fields, zeros)
    base |= {"success": np.array(success, bool), "steps": np.full(count, 2, np.int32)}
    base |= dict.fromkeys(("radius", "polar", "azimuth"), zeros[:, None])
    flags = ("loose", "safe", "invalid", "collided", "lost")
    base |= {name: np.zeros(count, bool) for name in flags}
    base |= {"trocar": np.zeros(count, np.int32) if trocar is None else np.array(trocar, np.int32)}
    base |= {name: np.zeros(count, np.int32) for name in ("trial", "stage")}
    base |= {"labels": {name: np.arange(count, dtype=np.int32) for name in ("source", "target")}}
    by_step = np.zeros(base["steps"].sum(), np.float16)
    base |= dict.fromkeys(table.BY_STEP, by_step)
    return table.Table(**(base | columns))


def test_wilson_against_published_values():
    np.testing.assert_allclose(statistics.wilson(60, 120), (0.4119, 0.5881), atol=1e-4)
    # Newcombe 1998, table I: 81/263, 15/148, 0/20, 1/29.
    np.testing.assert_allclose(statistics.wilson(81, 263), (0.2553, 0.3662), atol=1e-4)
    np.testing.assert_allclose(statistics.wilson(15, 148), (0.0624, 0.1605), atol=1e-4)
    np.testing.assert_allclose(statistics.wilson(0, 20), (0.0, 0.1611), atol=1e-4)
    np.testing.assert_allclose(statistics.wilson(1, 29), (0.0061, 0.1718), atol=1e-4)


def test_newcombe_against_published_values():
    # Newcombe 1998 (differences), table II, method 10: 56/70 - 48/80, 9/10 - 3/10, 10/10 - 0/10.
    for (a, n), (b, m), expected in [
        ((56, 70), (48, 80), (0.2, 0.0524, 0.3339)),
        ((9, 10), (3, 10), (0.6, 0.1705, 0.8090)),
        ((10, 10), (0, 10), (1.0, 0.6075, 1.0)),
    ]:
        gap, interval = statistics.generalization_gap(np.arange(n) < a, np.arange(m) < b)
        np.testing.assert_allclose((gap, *interval), expected, atol=1e-4)


def test_intervals_cover_what_they_say():
    rng = np.random.default_rng(0)
    p, q, n, m = 0.8, 0.6, 240, 120
    held = []
    for a, b in zip(rng.binomial(n, p, 2000), rng.binomial(m, q, 2000), strict=True):
        low, high = statistics.wilson(int(a), n)
        gap = statistics.generalization_gap(np.arange(n) < a, np.arange(m) < b)[1]
        held.append((low <= p <= high, gap[0] <= p - q <= gap[1]))
    assert (np.abs(np.mean(held, axis=0) - 0.95) < 0.015).all()


def test_mcnemar_counts_pairs_that_differ():
    a = np.array([1] * 10 + [0] * 2 + [1] * 50, bool)
    b = np.array([0] * 10 + [1] * 2 + [1] * 50, bool)
    found = statistics.mcnemar(a, b)
    assert (found["only_a"], found["only_b"]) == (10, 2)
    assert found["p_value"] == pytest.approx(2 * (1 + 12 + 66) / 2**12)
    assert statistics.mcnemar(a, a)["p_value"] == 1.0
    with pytest.raises(ValueError, match="a, b"):
        statistics.mcnemar(a, b[:-1])


def test_impossible_counts_are_named():
    for successes, count in ((1, 0), (3, 2), (-1, 2)):
        with pytest.raises(ValueError, match="successes, trials"):
            statistics.wilson(successes, count)
    with pytest.raises(ValueError, match="seen, unseen"):
        statistics.generalization_gap(np.ones(3, bool), np.ones(0, bool))


def test_result_splits_seen_and_unseen():
    found = statistics.compose(
        trials([1, 1, 0, 1, 0, 0], trocar=[0, 0, 1, 1, 2, 2]),
        np.array([True, True, False]),
        method="m",
        observation="state",
        seed=3,
    )
    assert found["seen"]["successes"] == 3 and found["seen"]["trials"] == 4
    assert found["unseen"]["rate"] == 0.0 and found["strict"]["all"]["rate"] == 0.5
    assert found["generalization_gap"] == 0.75
    assert [t["rate"] for t in found["per_trocar"]] == [1.0, 0.5, 0.0]
    assert [t["seen"] for t in found["per_trocar"]] == [True, True, False]
    assert [t["seen"] for t in found["trials"]] == [True] * 4 + [False] * 2
    assert {t["seed"] for t in found["trials"]} == {3}
    json.dumps(found, allow_nan=False)


def test_every_outcome_is_split_and_times_are_of_successes():
    steps = np.array([2, 4, 60, 60], np.int32)
    found = statistics.compose(
        trials(
            [1, 1, 0, 0],
            trocar=[0, 0, 1, 1],
            loose=np.array([1, 1, 1, 0], bool),
            safe=np.array([1, 0, 0, 0], bool),
            steps=steps,
            **dict.fromkeys(table.BY_STEP, np.zeros(steps.sum(), np.float16)),
            rcm_max=np.full(4, 2e-3, np.float32),
            rcm_within_max=np.full(4, 3e-3, np.float32),
            rcm_commanded_max=np.full(4, 1e-3, np.float32),
        ),
        np.array([True, False]),
        method="m",
        observation="state",
        seed=0,
    )
    for outcome, counts in {"strict": [2, 0, 2], "loose": [2, 1, 3], "safe": [1, 0, 1]}.items():
        parts = found[outcome]
        assert [parts[part]["successes"] for part in ("seen", "unseen", "all")] == counts
    assert found["steps"] == {"mean": 3.0, "median": 3.0}
    names = ("rcm_max_mm", "rcm_within_max_mm", "rcm_commanded_max_mm")
    assert [found["trials"][0][name] for name in names] == pytest.approx([2.0, 3.0, 1.0])


def test_a_result_without_unseen_trocars_has_no_gap():
    found = statistics.compose(
        trials([1, 0]), np.array([True]), method="m", observation="state", seed=0
    )
    assert found["generalization_gap"] is None and found["unseen"]["rate"] is None
    json.dumps(found, allow_nan=False)


def test_executed_error_is_pooled_over_steps():
    steps = np.array([1, 999], np.int32)
    series = np.concatenate([[5.0], np.linspace(0.0, 1.0, 999)]).astype(np.float16)
    found = statistics.rcm_error_mm(
        trials(
            [1, 0],
            steps=steps,
            rcm_error_mm=series,
            rcm_within_mm=2 * series,
            rcm_within_max=np.array([11e-3, 2e-3], np.float32),
            rcm_mean=np.array([5e-3, 0.5e-3], np.float32),
            rcm_max=np.array([5e-3, 1e-3], np.float32),
            rcm_commanded_max=np.array([1e-6, 3e-6], np.float32),
        )
    )
    assert found["commanded"]["max"] == pytest.approx(3e-3)
    assert found["executed"]["mean"] == pytest.approx(0.5045)  # not 2.75, the mean of trials
    assert found["executed"]["p99"] == pytest.approx(0.99, abs=2e-3)
    assert found["executed"]["max"] == pytest.approx(5.0)
    assert found["executed"]["p99_of_successes"] == pytest.approx(5.0)
    within = {"p99": 1.98, "max": 11.0, "p99_of_successes": 10.0}
    assert found["within_steps"] == pytest.approx(within, abs=4e-3)


def test_without_a_success_there_is_no_error_of_successes():
    steps, series = np.array([2], np.int32), np.array([50.0, 50.0], np.float16)
    found = statistics.rcm_error_mm(
        trials([0], steps=steps, rcm_error_mm=series, rcm_within_mm=series)
    )
    for kind in ("executed", "within_steps"):
        assert found[kind]["p99"] == 50.0 and found[kind]["p99_of_successes"] is None


def test_selection_keeps_steps_with_their_trials():
    found = trials(
        [1, 0, 1],
        steps=np.array([2, 1, 3], np.int32),
        rcm_error_mm=np.arange(6, dtype=np.float16),
        rcm_within_mm=np.arange(6, 12, dtype=np.float16),
    )
    kept = table.select(found, np.array([True, False, True]))
    np.testing.assert_array_equal(kept.rcm_error_mm, [0, 1, 3, 4, 5])
    np.testing.assert_array_equal(kept.rcm_within_mm, [6, 7, 9, 10, 11])
    joined = table.join([kept, table.select(found, np.array([False, True, False]))])
    np.testing.assert_array_equal(joined.success, [1, 1, 0])


@pytest.mark.parametrize("arms", [1, 2])
def test_each_count_and_place_is_its_own(arms):
    places = {"radius": [0.01, 0.02], "polar": [1.5, 1.6], "azimuth": [3.0, 4.0]}
    places = {name: np.add.outer(values, 0.1 * np.arange(arms)) for name, values in places.items()}
    steps = np.array([1, 2, 6, 9], np.int32)
    found = statistics.compose(
        trials(
            [1, 1, 1, 0],
            trocar=[0, 0, 1, 1],
            steps=steps,
            invalid=np.array([0, 0, 0, 1], bool),
            collided=np.array([0, 1, 0, 1], bool),
            lost=np.array([0, 0, 1, 0], bool),
            **{name: np.repeat(np.float32(x), 2, axis=0) for name, x in places.items()},
            **dict.fromkeys(table.BY_STEP, np.zeros(steps.sum(), np.float16)),
        ),
        np.array([True, False]),
        method="m",
        observation="state",
        seed=0,
    )
    assert (found["invalid"], found["collided"], found["safe_rcm_mm"]) == (1, 2, 2.0)
    assert found["steps"] == {"mean": 3.0, "median": 2.0}
    for rows, at in ((found["per_trocar"], [0, 1]), (found["trials"], [0, 0, 1, 1])):
        for name, values in places.items():
            np.testing.assert_allclose([row[name] for row in rows], values[at], rtol=1e-6)
    assert [row["lost"] for row in found["trials"]] == [False, False, True, False]
    assert found["trials"][3]["labels"] == {"source": 3, "target": 3}
