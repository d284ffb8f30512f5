"""The numbers of the tables, against hand counts."""

import itertools

import numpy as np
import pytest
from report.conftest import edited

from starjax.report import captions, compare, formats, outcomes, results, stats, tables


def only(ours, theirs):
    """Pairs, trials that ours alone wins, that theirs alone wins."""
    won = [(a.success, b.success) for a, b in zip(ours, theirs, strict=True)]
    return [str(n) for n in (len(won), won.count((True, False)), won.count((False, True)))]


def test_tallies_are_those_of_result_json(one):
    seen, unseen = (outcomes.tally(t) for t in outcomes.split(one.trials))
    figures = one.result.figures
    for rate, said in ((seen, figures["seen"]), (unseen, figures["unseen"])):
        assert (rate.successes, rate.trials) == (said["successes"], said["trials"])
        np.testing.assert_allclose([rate.low, rate.high], said["ci95"])
    safe = outcomes.tally(one.trials, outcomes.safe)
    assert safe.successes == figures["safe"]["all"]["successes"]
    gap = [figures["generalization_gap"], *figures["generalization_gap_ci95"]]
    np.testing.assert_allclose(stats.gap(seen, unseen), gap)


def test_paired_counts_are_of_each_pair_of_policies(several):
    rows = tables.paired(several)[1:]
    for run, row in zip(several[:2], rows, strict=True):
        assert row[:4] == [run.label, *only(several[2].trials, run.trials)]
        assert int(row[2]) > int(row[3])
    twin = edited(several[1], method="stardiff_single")
    twin = twin._replace(path=several[1].path.parent / "stardiff_single")
    together = tables.paired([*several, twin])[1:]  # one policy is one comparison
    assert together[:2] == rows and together[2] == rows[1]


def test_any_two_methods_are_compared(several):
    own = several[:2]
    (head, row) = tables.paired(own)  # neither is STAR-Diff
    assert head[2:4] == ["Only the first", "Only the second"]
    assert row[1:4] == only(own[0].trials, own[1].trials)
    assert all(run.label in row[0] for run in own)
    every = tables.paired(several, "all")[1:]
    assert len(every) == 3 and row[:4] in [other[:4] for other in every]
    holm = stats.holm([compare.pair(a, b).p for a, b in itertools.combinations(several, 2)])
    assert [other[5] for other in every] == [formats.p_value(p) for p in holm]
    head, *against = tables.paired(several, "dp_ee")
    assert head[2] == "Only DP-EE" and [r[0] for r in against] == [r.label for r in several[1:]]
    assert against[0][1:4] == only(several[0].trials, several[1].trials)
    twin = edited(own[1], method="stardiff_single")
    twin = twin._replace(path=own[1].path.parent / "stardiff_single")
    assert len(tables.paired([*own, twin], "all")) == 3  # one policy is not compared with itself


def test_pairs_are_trials_both_ran_with_one_limit_at_one_place(several):
    first, second = several[0], several[2]
    for angle, pairs in ((0.1, None), (4e-6, 72)):  # sweep of a grid; of another machine
        moved = [t._replace(azimuth=(t.azimuth[0] + angle,)) for t in second.trials]
        found = compare.pair(first, edited(second, moved))
        assert pairs == (found and found.pairs)
    other = second.trials[0]._replace(seed=9)
    found = compare.pair(first, edited(second, [*second.trials[5:], other]))
    assert [str(n) for n in found[:3]] == only(first.trials[5:], second.trials[5:])
    assert compare.pair(first, edited(second, [])) is None
    assert compare.pair(first, edited(second, time_limit_s=4.0)) is None


def test_trials_under_other_settings_of_jax_are_not_paired(several):
    first, second = several[0], several[2]
    settings = {"jax_settings": {"jax_default_matmul_precision": "highest"}}
    other = edited(second, about=settings)
    assert compare.pair(first, second) and compare.pair(first, other) is None
    assert compare.pair(other, other)
    assert captions.notes([first, other]) != captions.notes([first, second])


@pytest.mark.parametrize("first", ["timeout", "loose", "lost", "collided", "invalid"])
def test_a_failure_counts_under_the_first_class_that_applies(one, first):
    order = ["invalid", "collided", "lost", "loose", "timeout"]
    held = order[order.index(first) : -1]
    fields = {name: name in held for name in order[:-1]}
    trial = one.trials[0]._replace(success=False, **fields)
    assert outcomes.failures([trial, trial._replace(success=True)]) == {first: 1}


def test_table_four_joins_what_was_benchmarked(one):
    ms = {"p50": 2.0, "p95": 4.0, "p99": 5.0}
    quick = {"p50": 0.25, "p95": 0.3, "p99": 0.5}
    about = {"inference_ms_by_ddim_steps": {"100": ms, "1": ms}, "roll_network_ms": quick}
    rows = tables.inference([edited(one, about=about)])[1:]
    assert [row[1] for row in rows] == ["1", "10", "100", "–"]
    assert rows[0][2:] == ["2.0", "4.0", "5.0", "500", "200"] and rows[3][2] == "0.250"
    bench = {"inference_ms_by_ddim_steps": {"5": ms, "10": ms}}  # counts more than the result
    assert results.latencies(edited(one, about=about)._replace(bench=bench)) == [(5, ms), (10, ms)]


def test_holm_steps_down():
    # Sorted 0.01, 0.02, 0.04 are multiplied by 3, 2, 1 and never decrease.
    assert stats.holm([0.02, 0.01, 0.04]) == pytest.approx([0.04, 0.03, 0.04])
    assert stats.holm([0.6, 0.7]) == [1.0, 1.0]


@pytest.mark.parametrize("value", [0.0, 3e-5, 0.0041, 0.23, 12.0])
def test_small_errors_are_never_shown_as_zero(value):
    text = formats.millimetres(value)
    assert "e" not in text and (value == 0 or float(text.removeprefix("<")) > 0)
