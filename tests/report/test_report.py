"""The report: numbers against hand counts, nothing invented, nothing left empty."""

import dataclasses
import html
import json
import pathlib
import re
import shutil
import subprocess
import sys
import types

import imageio_ffmpeg
import jax
import numpy as np
import pytest
import synthetic
from matplotlib import colors
from matplotlib.figure import Figure

from starjax import config
from starjax.experiments import folders, report_command
from starjax.report import (
    build,
    captions,
    figures,
    markup,
    outcomes,
    page,
    ports,
    results,
    sections,
    stats,
    style,
    tables,
    trajectories,
    video,
)
from starjax.runtime import files
from starjax.sim import env, physics, scene

SIM = types.SimpleNamespace(pegs=np.zeros((12, 2)))  # where no joints were recorded


@pytest.fixture(scope="module")
def one(tmp_path_factory):
    return results.load(synthetic.run(tmp_path_factory.mktemp("one") / "stardiff"))


@pytest.fixture(scope="module")
def several(tmp_path_factory):
    out = tmp_path_factory.mktemp("several")
    skills = {"dp_ee": (0.5, 0.1), "dp_rcm4": (0.8, 0.5), "stardiff": (0.95, 0.9)}
    return [
        results.load(synthetic.run(out / name, name, skill, seed=seed))
        for seed, (name, skill) in enumerate(skills.items())
    ]


def edited(run, **changes):
    return run._replace(result={**run.result, **changes})


def test_tallies_are_those_of_result_json(one):
    seen, unseen = (outcomes.tally(t) for t in outcomes.split(one.trials))
    for rate, said in ((seen, one.result["seen"]), (unseen, one.result["unseen"])):
        assert (rate.successes, rate.trials) == (said["successes"], said["trials"])
        np.testing.assert_allclose([rate.low, rate.high], said["ci95"])
    safe = outcomes.tally(one.trials, outcomes.safe)
    assert safe.successes == one.result["safe"]["all"]["successes"]
    assert stats.gap(seen, unseen)[0] == pytest.approx(one.result["generalization_gap"])


def test_headlines_are_those_of_the_result(one):
    found = {name: (value, more) for name, value, _, more in sections._headlines(one)}
    for part in ("seen", "unseen"):
        said = one.result[part]
        value, more = found[f"Success, {part} trocars"]
        assert value == f"{100 * said['rate']:.0f}"
        assert f"{said['successes']} of {said['trials']}" in more
    gap = one.result["generalization_gap"]
    assert found["Generalization gap"][0] == f"{100 * gap:+.0f}"
    won = [trial["steps"] / env.CONTROL_HZ for trial in one.trials if trial["success"]]
    value, more = found["Time a transfer"]
    assert value == f"{np.median(won):.1f}" and f" {len(won)} succ" in more


def test_the_headline_of_the_rcm_error_is_its_quantile_and_the_worst_within_steps(one):
    errors = {"executed": {"p99": 4.0, "max": 5.0}, "within_steps": {"max": 7.0}}
    headlines = sections._headlines(edited(one, rcm_error_mm=errors))
    (said,) = [x[1:] for x in headlines if x[0] == "Shaft off the trocar"]
    assert said == ("4.000", " mm", "99th percentile of steps' ends; 7.000 mm at worst")


def test_the_time_of_all_phases_and_what_of_it_was_compiling(one):
    assert tables.phases([one])[1][-2:] == ["11 min 36 s", "31 s"]


def test_the_gap_on_the_page_is_that_of_the_table(several):
    text = sections.comparison(several)
    rows = tables.success(several)[1:]
    assert len(rows) == len(several)
    for row in rows:
        assert re.search(rf"<td>{row[1]}</td>.*{re.escape(row[4])}</td></tr>", text)


def test_paired_counts_stand_under_their_own_names(several):
    ours = several[2]
    for run, row in zip(several[:2], tables.paired(several)[1:], strict=True):
        both = list(zip(ours.trials, run.trials))
        only_ours = sum(a["success"] > b["success"] for a, b in both)
        only_theirs = sum(a["success"] < b["success"] for a, b in both)
        assert row[:4] == [run.label, str(len(both)), str(only_ours), str(only_theirs)]
        assert only_ours > only_theirs


def test_methods_that_are_one_policy_are_one_comparison(several):
    theirs = several[1]
    single = theirs._replace(path=theirs.path.parent / "stardiff_single")
    twin = edited(single, method="stardiff_single")
    (_, *alone), (_, *together) = tables.paired(several), tables.paired([*several, twin])
    assert together[:2] == alone and together[2] == alone[1]
    of_weights = [edited(x, weights="a")._replace(path=x.path / "x") for x in (theirs, twin)]
    assert tables.paired([several[0], *of_weights, several[2]])[1:] == together


def test_results_of_one_method_side_by_side_are_compared_each_by_itself(several, tmp_path):
    ours = several[2]
    lost = [{**trial, "success": False} for trial in ours.trials]
    near = [{**trial, "success": trial["success"] and i > 1} for i, trial in enumerate(ours.trials)]
    others = [
        edited(several[1], trials=trials)._replace(path=tmp_path / f"dp_rcm4-{i}")
        for i, trials in enumerate((near, lost))
    ]
    assert [row[4:] for row in tables.paired([*others, ours])[1:]] == [
        ["0.50", "0.50"],
        ["<0.0001", "<0.0001"],
    ]


def test_trials_of_other_limits_are_neither_paired_nor_pooled(several):
    short = several[1]._replace(limit_s=4.0)
    assert results.pair(several[2], several[1]) and results.pair(several[2], short) is None
    assert "Trials were given 4, 60 s; runs with" in "".join(captions.notes([several[2], short]))
    swept = several[2]._replace(sweep=several[2].trials)
    both, alone = (
        sum(rate.trials for _, rate in figures._pooled(run))
        for run in (swept, swept._replace(sweep_limit_s=30.0))
    )
    assert both == 2 * alone
    assert (
        "sweep's trials were given 30 s" in captions.notes([swept._replace(sweep_limit_s=30.0)])[-1]
    )


@pytest.fixture(scope="module")
def sweeps(tmp_path_factory):
    out = tmp_path_factory.mktemp("sweeps")
    skills = {"dp_ee": (0.5, 0.1), "stardiff": (0.95, 0.9)}
    return [
        results.load(synthetic.run(out / name, name, skill, sweep_of=300))
        for name, skill in skills.items()
    ]


def test_trials_of_a_sweep_are_told_by_distance(sweeps):
    table = tables.swept(sweeps)
    assert table[0][:4] == ["Method", "Strict", "Safe", "0 to 10 mm"]
    for run, row in zip(sweeps, table[1:], strict=True):
        parts = [
            [t for t in run.sweep if low <= 1e3 * t["distance_m"] < low + 10]
            for low in range(0, 10 * len(row[3:]), 10)
        ]
        expected = [tables.rate(outcomes.tally(part)) if part else "–" for part in parts]
        assert row[3:] == expected and sum(map(len, parts)) == 300
        assert row[1] == tables.rate(outcomes.tally(run.sweep))
        assert row[2] == tables.rate(outcomes.tally(run.sweep, outcomes.safe))
    assert len(tables.swept([sweeps[0]._replace(sweep=[])])) == 1
    for text in (tables.markdown(sweeps), page.render(sweeps, sweeps[1], {}, None)):
        assert tables.SWEPT in text and tables.SWEPT_PAIRED in text


def test_sweeps_are_paired_where_they_met_the_same_trocars(sweeps):
    theirs, ours = sweeps
    (_, row) = tables.paired(results.swept(sweeps))
    both = list(zip(ours.sweep, theirs.sweep))
    assert row[1:4] == [
        "300",
        str(sum(a["success"] > b["success"] for a, b in both)),
        str(sum(a["success"] < b["success"] for a, b in both)),
    ]
    # of a grid, say: the same numbers and seed, other places
    moved = [{**trial, "azimuth": trial["azimuth"] + 0.1} for trial in theirs.sweep]
    assert len(tables.paired(results.swept([theirs._replace(sweep=moved), ours]))) == 1
    near = [{**trial, "azimuth": trial["azimuth"] + 4e-6} for trial in theirs.sweep]
    (_, again) = tables.paired(results.swept([theirs._replace(sweep=near), ours]))
    assert again == row
    assert len(tables.paired(results.swept([theirs._replace(sweep_limit_s=4.0), ours]))) == 1


def test_what_other_weights_left_beside_a_result_is_not_shown(tmp_path):
    run = synthetic.run(tmp_path / "stardiff")
    (trial, *_) = files.read_json(run / "result.json")["trials"]
    swept = {"weights": "a", "trials": [{**trial, "distance_m": 0.0}]}
    files.write_json(run / "sweep.json", swept)
    files.write_json(run / "bench.json", {"weights": "a", "inference_ms_by_ddim_steps": {}})
    for weights, count in ((None, 1), ("a", 1), ("b", 0)):
        result = files.read_json(run / "result.json")
        files.write_json(run / "result.json", result | ({"weights": weights} if weights else {}))
        found = results.load(run)
        assert (len(found.sweep), bool(found.bench)) == (count, bool(count))


def test_a_trajectory_of_another_evaluation_is_not_shown(tmp_path):
    run = synthetic.run(tmp_path / "stardiff")
    result = files.read_json(run / "result.json")
    shown = results.load(run).rollouts
    told = [results.identity(rollout.trial) for rollout in shown[:2]]
    for trial in result["trials"]:
        trial["steps"] += results.identity(trial) == told[0]
        trial["rcm_max_mm"] *= 1.001 if results.identity(trial) == told[1] else 1
    files.write_json(run / "result.json", result)
    assert len(results.load(run).rollouts) == len(shown) - 2
    for trial in result["trials"]:  # as older results are
        del trial["rcm_max_mm"]
    files.write_json(run / "result.json", result)
    assert len(results.load(run).rollouts) == len(shown) - 1


def test_the_map_shows_nothing_far_from_all_ports():
    axis = Figure().subplots()
    shown = figures._heat(axis, np.array([[20.0, 0.0]]), np.array([1.0]), np.array([1]))
    filled = np.isfinite(np.ma.filled(shown.get_array(), np.nan))
    assert filled[80, 112] and not filled[80, 48] and 0.02 < filled.mean() < 0.2


def test_a_run_named_twice_is_reported_once_and_an_evaluation_in_its_folder(tmp_path, monkeypatch):
    built = []
    monkeypatch.setattr(build, "build", lambda runs, out, **_: built.append((runs, out)))
    run = synthetic.run(tmp_path / "all" / "stardiff")
    other = shutil.copytree(run, tmp_path / "compact-seed0-4x30s")
    for typed in ([str(run.parent), f"{run}/../stardiff"], [str(other)], [str(other), str(run)]):
        assert report_command.main(typed) == 0
    first, second, third = built
    assert first == ([run], run.parent / "report")
    assert second == ([other], other / "report")
    assert third[0] == [other, run]


def test_rcm_errors_stand_under_their_own_names(one):
    executed = {"mean": 2.0, "p99_of_successes": 3.0, "p99": 4.0, "max": 5.0}
    within = {"p99": 6.0, "max": 7.0}
    errors = {"commanded": {"max": 1.0}, "executed": executed, "within_steps": within}
    header, row = tables.rcm([edited(one, rcm_error_mm=errors)])
    assert dict(zip(header[1:], row[1:])) == {
        "Commanded max": "1.000",
        "Executed mean": "2.000",
        "Executed p99 of successes": "3.000",
        "Executed p99": "4.000",
        "Executed max": "5.000",
        "Within steps p99": "6.000",
        "Within steps max": "7.000",
    }


def test_the_worst_error_at_a_trocar_is_its_largest(one):
    rows = re.findall(r"<tr>(.*?)</tr>", sections.per_trocar(one), re.S)[1:]
    for group, row in zip(outcomes.by_trocar(one.trials), rows, strict=True):
        worst = max(trial["rcm_within_max_mm"] for trial in group)
        assert f"{tables.millimetres(worst)} mm" in row


def test_the_page_is_about_stardiff_wherever_it_stands(several):
    for runs in (several, several[::-1]):
        assert build._focus(runs).result["method"] == "stardiff"


def test_a_benchmark_counts_more_than_the_timing_of_the_evaluation(one):
    bench = {"p50": 1.0, "p95": 1.0, "p99": 1.0}
    assert results.latencies(edited(one, inference_ms_by_ddim_steps={"10": bench})) == [(10, bench)]


def test_holm_steps_down():
    # Sorted 0.01, 0.02, 0.04 are multiplied by 3, 2, 1 and never decrease.
    assert stats.holm([0.02, 0.01, 0.04]) == pytest.approx([0.04, 0.03, 0.04])
    assert stats.holm([0.6, 0.7]) == [1.0, 1.0]


def test_seconds_are_the_environments():
    assert outcomes.CONTROL_HZ == env.CONTROL_HZ


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        ({}, "timeout"),
        ({"loose": True}, "loose"),
        ({"collided": True, "loose": True}, "collided"),
        ({"invalid": True, "collided": True}, "invalid"),
    ],
)
def test_a_failure_has_one_class(flags, expected):
    trial = {"success": False, "loose": False, "collided": False, "invalid": False, **flags}
    assert outcomes.failure(trial) == expected
    assert outcomes.failures([trial, {**trial, "success": True}]) == {expected: 1}


def test_distances_to_the_training_trocars(one):
    groups = [group[0] for group in outcomes.by_trocar(one.trials)]
    apart = 1e3 * outcomes.distances(groups, results.training_trocars(one))
    np.testing.assert_allclose(apart[:8], 0, atol=1e-4)
    np.testing.assert_allclose(apart[8:], [30.29, 21.04, 21.46, 20.0], atol=0.01)


def test_success_over_distance_begins_with_the_training_trocars(one):
    (at, score), *further = figures._pooled(one)
    seen, unseen = outcomes.split(one.trials)
    assert at == pytest.approx(0, abs=1e-3) and score == outcomes.tally(seen)
    assert sum(score.trials for _, score in further) == len(unseen) == 24


def test_intervals_are_drawn_from_their_low_to_their_high_end(one):
    scores = [score for _, score in figures._pooled(one)]
    ends = [[score.low, score.high] for score in scores]
    axis = Figure().subplots()
    style.rates(axis, range(len(scores)), scores, "stardiff", "")
    whiskers = [segment[:, 1] for segment in axis.collections[0].get_segments()]
    np.testing.assert_allclose(whiskers, ends)
    (band,) = figures.distance([one], one).axes[0].collections
    edges = np.unique(band.get_paths()[0].vertices[:, 1])
    np.testing.assert_allclose(edges, np.unique(ends))


def test_pairs_are_trials_both_ran(several):
    first, second = several[0], several[2]
    cut = edited(second, trials=[*second.trials[5:], {**second.trials[0], "seed": 9}])
    found = results.pair(first, cut)
    both = list(zip(first.trials[5:], second.trials[5:]))
    assert found.pairs == len(both)
    assert found.only_a == sum(a["success"] and not b["success"] for a, b in both)
    assert results.pair(first, edited(second, trials=[])) is None


def test_table_three_counts_and_marks_the_best(several):
    text = tables.markdown(several)
    for run in several:
        seen = sum(t["success"] for t in run.trials if t["seen"])
        assert re.search(rf"\| {run.label} \| \**{100 * seen / 48:.1f} \({seen}/48\)", text)
    assert text.count("**") == 4 and text.index("**") > text.index("| STAR-Diff |")
    assert "state observations" in text and "Holm" in text


def test_stars_are_each_runs_own(several):
    elsewhere = edited(several[0], trials=[t | {"seen": not t["seen"]} for t in several[0].trials])
    table = sections.matrix([elsewhere, several[1]])
    rows = re.findall(r"<tr>.*?</tr>", table, re.S)[1:]
    assert [row.count("*</td>") for row in rows] == [8, 4]
    rates = [outcomes.tally(group).rate for group in outcomes.by_trocar(several[1].trials)]
    assert re.findall(r">(\d+)\*?</td>", rows[1]) == [f"{100 * rate:.0f}" for rate in rates]


def test_one_method_has_no_empty_comparison(one):
    text = tables.markdown([one])
    assert "Paired" not in text and "**" not in text and "–" not in text


def test_table_four_joins_what_was_benchmarked(one):
    ms = {"p50": 2.0, "p95": 4.0, "p99": 5.0}
    quick = {"p50": 0.25, "p95": 0.3, "p99": 0.5}
    run = edited(one, inference_ms_by_ddim_steps={"100": ms, "1": ms}, roll_network_ms=quick)
    rows = tables.inference([run])[1:]
    assert [row[1] for row in rows] == ["1", "10", "100", "–"]
    assert rows[0][2:] == ["2.0", "4.0", "5.0", "500", "200"]
    assert rows[3][0].endswith("roll network alone") and rows[3][2] == "0.250"


def test_table_four_says_where_it_was_timed(one):
    ms = {"p50": 2.0, "p95": 4.0, "p99": 5.0}
    old = edited(one, inference_ms_by_ddim_steps={"1": ms, "2": ms}, roll_network_ms=ms)
    gpu = {"backend": "gpu", "devices": ["NVIDIA H200"]}
    timed = {"inference_ms_by_ddim_steps": {"5": ms}, "roll_network_ms": None, "hardware": gpu}
    run = old._replace(bench=timed)
    assert [row[1] for row in tables.inference([run])[1:]] == ["5", "10"]
    for text in (tables.markdown([run]), html.unescape(sections.measurements([run]))):
        assert "STAR-Diff's rows of 5 steps are of 1 x NVIDIA H200." in text
    here = run._replace(bench={**timed, "hardware": one.result["hardware"]})
    assert tables.inference_note([here, old, one]) == tables.INFERENCE_NOTE


@pytest.mark.parametrize("value", [0.0, 3e-5, 0.0041, 0.23, 12.0])
def test_small_errors_are_never_shown_as_zero(value):
    text = tables.millimetres(value)
    assert "e" not in text and (value == 0 or float(text.removeprefix("<")) > 0)


def test_the_verdict_says_what_is_sure(one):
    def trials(seen, unseen):
        return [
            {**one.trials[0], "seen": s, "success": i < k, "trial": i}
            for s, k in ((True, seen), (False, unseen))
            for i in range(50)
        ]

    def said(seen, unseen):
        return captions.verdict([one], edited(one, trials=trials(seen, unseen)))

    assert "costs it 60.0 points" in said(45, 15)
    assert "may be chance" in said(25, 24)
    assert "as well on the new ones (95% interval" in said(25, 25)
    assert "better on the new ones, by 60.0 points (95% interval 4" in said(15, 45)
    assert "costs it 16.0 points (95% interval 0.2 to" in said(44, 36)
    assert "not evaluated" in captions.verdict([one], edited(one, trials=[]))


def test_the_verdict_begins_with_the_trocars_that_were_seen(one):
    seen, unseen = (outcomes.tally(trials) for trials in outcomes.split(one.trials))
    said = captions.verdict([one], one)
    first, second = (f"{rate.successes} of {rate.trials}" for rate in (seen, unseen))
    assert said.index(first) < said.index(second)


def test_the_verdict_ends_with_the_best_of_the_others(several):
    best = outcomes.tally(outcomes.split(several[1].trials)[1])
    said = captions.verdict(several, several[2])
    assert said.endswith(f" trocars, DP-RCM-4, reached {100 * best.rate:.0f}%.")


def test_the_page_stands_alone(several):
    text = page.render(several, several[-1], {"fig4": (b"light", b"dark")}, b"mp4")
    assert "<script" not in text and "http" not in text
    assert all(
        url.startswith("data:") for url in re.findall(r'(?:src|href|srcset)="([^"]*)"', text)
    )
    assert captions.verdict(several, several[-1]) in text
    assert all(run.label in text for run in several)


def test_the_page_escapes_what_it_shows(one):
    run = edited(one, command="run --out '<b>&'", warnings=["<i>"])
    text = page.render([run], run, {}, None)
    assert "&lt;b&gt;&amp;" in text and "&lt;i&gt;" in text and "<b>&" not in text


def test_a_stage_that_did_not_run_leaves_no_trace(one):
    parts = ("trials", "inference_ms", "rcm_error_mm", "timings_s", "warnings", "command")
    run = edited(one, **dict.fromkeys(parts), versions=None, hardware=None, config={})
    text = page.render([run], run, {}, None)
    assert "<h2>" not in text and "None" not in text and "<video" not in text
    assert tables.markdown([run]).count("|") == 0
    assert figures.training([run._replace(curves=[])]) is None


def test_the_interval_bar_is_where_the_rate_is():
    bar = markup.interval(stats.rate(3, 4), "seen")
    left, width, tick = (float(x) for x in re.findall(r"(?:left|width):([\d.]+)%", bar))
    assert tick == 75 and left < 75 < left + width <= 100.01


def test_build_writes_every_file(tmp_path):
    run = synthetic.run(tmp_path / "stardiff", sweep_of=40)
    index = build.build([run], tmp_path / "report", with_video=False)
    written = {path.name: path.read_bytes() for path in (tmp_path / "report").glob("[!.]*")}
    assert sorted(written) == sorted(
        ["tables.md", "fig3.png", "fig3.pdf", "fig4.png", "fig4.pdf", "training.png", "index.html"]
    )
    for name, data in written.items():
        magic = {"png": b"\x89PNG", "pdf": b"%PDF"}.get(name.split(".")[1], b"")
        assert data.startswith(magic) and len(data) > 500
    build.build([run], tmp_path / "report", with_video=False)
    assert index.read_bytes() == written["index.html"]


def test_two_reports_do_not_write_into_one_folder(tmp_path):
    run = synthetic.run(tmp_path / "stardiff")
    with files.lock(tmp_path / "report"), pytest.raises(files.StorageError, match="in use by"):
        build.build([run], tmp_path / "report")


def test_build_without_rollouts_or_results(tmp_path):
    run = synthetic.run(tmp_path / "dp_ee", "dp_ee")
    (run / "evaluation" / "recorded.npz").unlink()
    build.build([run], tmp_path / "report")
    assert {"fig3.png", "rollout.mp4"}.isdisjoint(p.name for p in (tmp_path / "report").iterdir())
    (run / "result.json").unlink()
    with pytest.raises(ValueError, match=r"result\.json"):
        build.build([run], tmp_path / "report")
    with pytest.raises(ValueError, match="at least one"):
        build.build([], tmp_path / "report")


def test_weights_that_are_shared_bring_their_curves(tmp_path):
    owner = synthetic.run(tmp_path / "dp_ee", "dp_ee")
    borrower = synthetic.run(tmp_path / "dp_ee_proj", "dp_ee_proj")
    (borrower / "metrics.jsonl").unlink()
    runs = [results.load(path) for path in (owner, borrower)]
    assert runs[1].curves == runs[0].curves != []
    assert len(figures.training(runs).axes[0].lines) == 1


def test_runs_side_by_side_have_each_their_curve(tmp_path):
    runs = [results.load(synthetic.run(tmp_path / name, seed=i)) for i, name in enumerate("ab")]
    assert len(figures.training(runs).axes[0].lines) == 2


def test_a_curve_of_one_point_shows(one):
    (axis, *_) = figures.training([one._replace(curves=[{"step": 1, "loss": 0.5}])]).axes
    assert axis.lines[0].get_marker() == "o"
    assert {line.get_marker() for line in figures.training([one]).axes[0].lines} == {"None"}


def test_recorded_rollouts_end_where_the_trial_did(one):
    assert len(one.rollouts) == 36
    for rollout in one.rollouts:
        assert len(rollout.p_world_tip) == rollout.trial["steps"]
        assert np.isfinite(rollout.p_world_tip).all()


def with_qpos(run):
    rollouts = [r._replace(qpos=np.zeros((len(r.p_world_tip), 2))) for r in run.rollouts]
    return run._replace(rollouts=rollouts)


def test_the_video_shows_seen_and_unseen_whatever_their_outcome(one):
    def chosen(run):
        return [(r.trial["trocar"], r.trial["trial"]) for _, r in video.choose([run])]

    run = with_qpos(one)
    assert [trocar < 8 for trocar, _ in chosen(run)] == [True, True, False, False]
    assert len(set(chosen(run))) == 4
    turned = [
        r._replace(trial={**r.trial, "success": not r.trial["success"]}) for r in run.rollouts
    ]
    assert chosen(run._replace(rollouts=turned)) == chosen(run)
    assert chosen(one) == []


def test_a_clip_says_what_it_shows_and_how_it_ended(one, monkeypatch):
    said = []

    def caption(rows, width):
        said.append(rows)
        return np.zeros((44, width, 3), np.uint8)

    monkeypatch.setattr(video, "caption", caption)
    for seen in (True, False):
        rollout = next(r for r in one.rollouts if r.trial["seen"] == seen)
        rollout = rollout._replace(p_world_tip=rollout.p_world_tip[:3])
        list(video._clip(lambda *_: np.zeros((16, 8, 8, 3), np.uint8), "m", rollout, ""))
        (_, (ended, _)), ((about, _), _) = said[-1]
        assert about == f"{'seen' if seen else 'unseen'} trocar {rollout.trial['trocar']}"
        assert ended.startswith("success") == rollout.trial["success"]


def test_methods_without_a_recorded_path_are_not_in_its_legend(several):
    silent, *recorded = several
    runs = [silent._replace(rollouts=[]), *recorded]
    (legend,) = trajectories.draw(runs, SIM).legends
    labels = [text.get_text() for text in legend.get_texts()]
    assert labels == [*(run.label for run in recorded), "failure", "trocar"]


@pytest.mark.parametrize(("won", "colour"), [(True, style.SUCCESS), (False, style.FAILURE)])
def test_paths_have_the_colour_of_their_outcome(one, won, colour):
    rollout = one.rollouts[0]
    rollout = rollout._replace(trial={**rollout.trial, "success": won})
    axis = trajectories.draw([one._replace(rollouts=[rollout])], SIM).axes[0]
    used = {line.get_color() for line in axis.lines}
    assert used & {style.SUCCESS, style.FAILURE} == {colour}


def test_shafts_are_drawn_where_the_joints_had_them(one):
    sim = scene.load()
    length, home = 20, sim.mj_model.qpos0.copy()
    home[sim.arm_q : sim.arm_q + 6] = sim.home
    rollout = one.rollouts[0]._replace(
        p_world_tip=one.rollouts[0].p_world_tip[:length], qpos=np.tile(home, (length, 1))
    )
    axis = trajectories.draw([one._replace(rollouts=[rollout])], sim).axes[0]
    fan = [line.get_xydata() for line in axis.lines if line.get_alpha() == 0.34]
    assert len(fan) == trajectories._FAN
    (tip,) = trajectories._poses(sim, home[None])
    for beyond, end in fan:
        np.testing.assert_allclose(end, trajectories._flat(tip.p), atol=1e-6)
        along = trajectories._flat(tip.R[:, 2])
        turned = np.cross(np.append(end - beyond, 0), np.append(along, 0))
        assert np.abs(turned).max() < 1e-6 and (end - beyond) @ along > 0


def test_a_tool_that_flew_off_does_not_shrink_the_boards(one):
    near = trajectories._frame(np.zeros((12, 2)), [one])
    far = one.rollouts[0]._replace(p_world_tip=one.rollouts[0].p_world_tip + 2.0)
    frame = trajectories._frame(np.zeros((12, 2)), [one._replace(rollouts=[far, *one.rollouts])])
    for (low, high), (lowest, highest) in zip(near, frame):
        assert lowest >= low - trajectories._ROOM and highest <= high + trajectories._ROOM


def trocar_only(runs):
    """Without joints, of which there is no shaft to draw."""
    return [run._replace(rollouts=[r._replace(qpos=None) for r in run.rollouts]) for run in runs]


def test_several_methods_are_shown_at_the_same_trial(several):
    chosen = video.choose([with_qpos(run) for run in several])
    assert [method for method, _ in chosen] == [run.label for run in several]
    trials = {(r.trial["trocar"], r.trial["trial"], r.trial["seen"]) for _, r in chosen}
    assert len(trials) == 1 and not trials.pop()[2]


def of_seed(run, seed):
    """The run as if its trials were of another seed."""
    rollouts = [r._replace(trial={**r.trial, "seed": seed}) for r in run.rollouts]
    trials = [{**trial, "seed": seed} for trial in run.trials]
    return edited(run._replace(rollouts=rollouts), trials=trials, seed=seed)


def test_trials_of_different_seeds_are_not_shown_as_one(several):
    runs = [with_qpos(of_seed(run, seed)) for run, seed in zip(several, (1, 0, 1))]
    shown = [several[0].label, several[2].label]
    assert [label for label, _ in video.choose(runs)] == shown
    drawn = trajectories.draw(trocar_only(runs), SIM).axes[0].lines
    colours = {style.method(run.result["method"])[0]: run.label for run in runs}
    assert {colours[x.get_color()] for x in drawn if x.get_color() in colours} == set(shown)


def test_figures_prefer_the_trials_that_stardiff_met(several):
    single = several[2]._replace(group="one")
    others = [of_seed(run._replace(group="two"), seed) for run, seed in zip(several, (4, 5))]
    assert results.representatives([*others, of_seed(single, 4)])[0] is others[0]
    assert results.representatives([*others, of_seed(single, 5)])[0] is others[1]


def test_a_clip_that_ends_early_stays_as_it_ended(one):
    short, long = (
        r._replace(p_world_tip=r.p_world_tip[:n], qpos=np.zeros((n, 2)))
        for r, n in zip(one.rollouts, (5, 20))
    )

    def draw(rollout, first):
        steps = np.arange(first, first + 16, dtype=np.uint8)
        return np.broadcast_to(steps[:, None, None, None], (16, 64, 64, 3))

    pictures = list(video.frames([("a", short), ("b", long)], draw))
    assert len(pictures) == 20 + 45
    pixels = np.array([[p[-1, 0, 0], p[-1, -1, 0]] for p in pictures])
    np.testing.assert_array_equal(pixels[:, 0], np.minimum(np.arange(65), 4))
    np.testing.assert_array_equal(pixels[:, 1], np.minimum(np.arange(65), 19))


@pytest.mark.parametrize("folder", ["a:1", "-x"])
def test_a_video_may_lie_in_any_folder(tmp_path, monkeypatch, folder):
    monkeypatch.chdir(tmp_path)
    path = pathlib.Path(folder) / "film.mp4"
    path.parent.mkdir()
    video.write([np.zeros((8, 8, 3), np.uint8)] * 3, path)
    assert path.stat().st_size


def test_labels_are_drawn_as_they_are_written_and_fit(several):
    long = "b$x^^$ " + 60 * "x"
    figure = figures.distance([run._replace(label=long) for run in several], several[0])
    (legend,) = figure.legends
    style.save(figure, "png")
    assert legend.get_texts()[0].get_text() == long
    assert legend.get_window_extent().x1 <= figure.bbox.x1


def test_a_cell_holds_any_name():
    assert tables.render([["Method"], ["a|b"]]).splitlines()[-1] == "| a\\|b |"


def test_seeds_of_trials_are_all_told_where_one_is_not_the_trainings(one):
    config = one.result["config"]
    own, other = (edited(one, seed=config["seed"] + i) for i in range(2))
    assert "Seed of the trials" not in sections.facts([own])
    told = f"<dt>Seed of the trials</dt><dd>{config['seed']}; {config['seed'] + 1}</dd>"
    assert told in sections.facts([own, other])


def test_the_video_plays_everywhere(tmp_path):
    ramp = (np.full((48, 64, 3), 8 * i, np.uint8) for i in range(30))
    video.write(ramp, tmp_path / "ramp.mp4")
    program = [imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(tmp_path / "ramp.mp4")]
    said = subprocess.run(program, capture_output=True, text=True).stderr
    assert "h264" in said and "yuv420p" in said and "64x48" in said and "30 fps" in said
    raw = [*program, "-f", "rawvideo", "-pix_fmt", "rgb24", "-loglevel", "error", "-"]
    back = np.frombuffer(subprocess.run(raw, capture_output=True).stdout, np.uint8)
    means = back.reshape(30, 48, 64, 3).mean((1, 2, 3))
    np.testing.assert_allclose(means, 8 * np.arange(30), atol=3)


@pytest.mark.parametrize("bad", [np.zeros((8, 8, 3)), np.zeros((7, 8, 3), np.uint8)])
def test_pictures_that_cannot_be_coded_are_refused(tmp_path, bad):
    with pytest.raises(ValueError, match="pictures: expected uint8"):
        video.write([bad], tmp_path / "bad.mp4")


def test_an_encoder_that_fails_says_so_and_leaves_what_was_there(tmp_path, monkeypatch):
    clip = tmp_path / "clip.mp4"
    clip.write_bytes(b"of before")
    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", lambda: shutil.which("false"))
    with pytest.raises(OSError, match=r"clip\.mp4: the video could not be written"):
        video.write([np.zeros((8, 8, 3), np.uint8)] * 3, clip)
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"of before"]


def test_the_renderer_draws_the_recorded_configuration(one, monkeypatch):
    made = scene.load()
    qpos = np.tile(made.mj_model.qpos0, (3, 1))
    near = one.rollouts[0]._replace(qpos=qpos, p_world_trocar=made.p_world_ref, target_peg=7)
    far = near._replace(p_world_trocar=made.p_world_ref + np.array([0, 0.04, 0], np.float32))
    poses, precisions = physics.geom_poses, set()

    def geom_poses(*args):
        precisions.add(jax.config.jax_default_matmul_precision)
        return poses(*args)

    monkeypatch.setattr(physics, "geom_poses", geom_poses)
    draw = video.renderer(made, size=64)
    here, there = draw(near, 0), draw(far, 0)
    assert precisions == {"highest"}
    assert here.shape[1:] == (64, 64, 3) and here.dtype == np.uint8
    assert (here[0] == here[2]).all() and (here[0] != there[0]).any()
    assert (draw(near._replace(target_peg=8), 0)[0] != here[0]).any()
    with pytest.raises(ValueError, match="joint positions"):
        draw(near._replace(qpos=None), 0)


def test_a_result_alone_is_enough_to_load(one, tmp_path):
    (tmp_path / "stardiff").mkdir()
    (tmp_path / "stardiff" / "result.json").write_text(json.dumps(one.result))
    assert results.load(tmp_path / "stardiff").trials == one.trials


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("result.json", b'{"method": "stardiff"'),
        ("result.json", b"{}"),
        ("result.json", b'{"method": "mine", "observation": "image", "config": {}}'),
        ("sweep.json", b'{"trials": ['),
        ("bench.json", b"{"),
        ("metrics.jsonl", b'{"step": 1\n{"step": 2}\n'),
        ("metrics.jsonl", b'{"step": 1, "note": "\xff"}\n'),
        ("metrics.jsonl", b"5\n"),
        ("evaluation/recorded.npz", b"PK"),
    ],
)
def test_a_damaged_file_of_a_run_is_named(one, tmp_path, name, content):
    (tmp_path / "evaluation").mkdir()
    (tmp_path / "result.json").write_text(json.dumps(one.result))
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=re.escape(str(tmp_path / name))):
        results.load(tmp_path)


@pytest.mark.parametrize(
    ("name", "place", "value", "said"),
    [
        ("result.json", "method", ["stardiff"], 'method: expected text, got ["stardiff"]'),
        ("result.json", "config", 3, "config: expected an object, got 3"),
        ("result.json", "config", None, "config: expected an object, got nothing"),
        ("result.json", "config.policy", None, "config.policy: expected an object, got nothing"),
        ("result.json", "trials", 5, "trials: expected a list, got 5"),
        ("result.json", "trials", [{"trocar": 0}], "trials[0].trial: expected a whole number"),
        ("result.json", "trials.0.seen", None, "trials[0].seen: expected true or false, got not"),
        ("result.json", "inference_ms", {"p50": 1.0}, "inference_ms.p95: expected a number"),
        ("result.json", "rcm_error_mm.executed", {"p99": 1.0}, "rcm_error_mm.executed.max: exp"),
        ("result.json", "timings_s.train", "1 s", 'timings_s.train: expected a number, got "1 s"'),
        ("sweep.json", "trials.0.distance_m", "far", "trials[0].distance_m: expected a number"),
    ],
)
def test_what_is_wrong_in_a_file_of_a_run_is_said(tmp_path, name, place, value, said):
    run = synthetic.run(tmp_path / "stardiff", sweep_of=1)
    found = part = files.read_json(run / name)
    *path, last = place.split(".")
    for key in path:
        part = part[int(key)] if isinstance(part, list) else part[key]
    part[last] = value
    files.write_json(run / name, found)
    with pytest.raises(ValueError, match=re.escape(f"{run / name}: {said}")):
        results.load(run)


def test_trajectories_without_their_lengths_are_damaged(tmp_path):
    run = synthetic.run(tmp_path / "stardiff")
    file = run / "evaluation" / "recorded.npz"
    kept = files.read_npz(file)
    del kept["length"]
    files.write_npz(file, kept)
    with pytest.raises(ValueError, match=re.escape(f"{file} is damaged: no length in it")):
        results.load(run)


def test_a_log_that_ends_within_a_line_ends_before_it(one, tmp_path):
    (tmp_path / "result.json").write_text(json.dumps(one.result))
    (tmp_path / "metrics.jsonl").write_text('{"step": 1}\n{"step": 2')
    assert results.load(tmp_path).curves == [{"step": 1}]


@pytest.mark.parametrize(
    ("seeds", "names"), [((0, 0), ("a/stardiff", "b/stardiff")), ((0, 3), ("seed 0", "seed 3"))]
)
def test_runs_of_one_method_are_told_apart(tmp_path, seeds, names):
    paths = [synthetic.run(tmp_path / x / "stardiff", seed=i) for x, i in zip("ab", seeds)]
    build.build(paths, tmp_path / "report", with_video=False)
    text = (tmp_path / "report" / "tables.md").read_text()
    assert all(f"STAR-Diff ({name})" in text for name in names)


def test_two_evaluations_of_one_policy_are_told_from_two_trainings(one):
    def named(*changes):
        runs = [edited(one, **change)._replace(path=one.path / f"{i}/x") for i, change in changes]
        return [run.label.removeprefix("STAR-Diff ") for run in build._named_apart(runs)]

    settings = one.result["config"]
    trained = [{"config": {**settings, "seed": seed}, "seed": 7} for seed in (0, 3)]
    assert named(*enumerate(trained)) == ["(seed 0)", "(seed 3)"]
    scored = [{"config": settings, "seed": seed} for seed in (0, 7)]
    assert named(*enumerate(scored)) == ["(trials of seed 0)", "(trials of seed 7)"]
    other = {**settings, "train": {**settings["train"], "steps": 9}}
    assert named(*enumerate([scored[0], {"config": other, "seed": 7}])) == ["(0/x)", "(1/x)"]
    unknown = {"config": {**settings, "seed": None}, "seed": 7}
    assert named(*enumerate([unknown, trained[0]])) == ["(0/x)", "(1/x)"]
    old = [{"config": {**settings, "seed": seed}} for seed in (0, 7)]
    assert named(*enumerate(old)) == ["(seed 0)", "(seed 7)"]


def test_another_seed_of_the_trials_is_a_fact(one):
    assert "Seed of the trials" not in sections.facts([edited(one, seed=0)])
    assert "<dt>Seed of the trials</dt><dd>7</dd>" in sections.facts([edited(one, seed=7)])
    unknown = edited(one, seed=7, config={**one.result["config"], "seed": None})
    assert "<dt>Seed</dt>" not in sections.facts([unknown])
    assert "seed = unknown" in sections.reproduce([unknown])


def test_folders_of_one_name_are_told_apart_further_up(tmp_path):
    skills = {"a": (1.0, 1.0), "b": (0.0, 0.0)}
    paths = [synthetic.run(tmp_path / x / "cpu" / "stardiff", skill=s) for x, s in skills.items()]
    build.build(paths, tmp_path / "report", with_video=False)
    text = (tmp_path / "report" / "tables.md").read_text()
    assert all(f"STAR-Diff ({x}/cpu/stardiff)" in text for x in skills)
    (failed,) = re.findall(r"\| STAR-Diff \(b/cpu/stardiff\) \|([ \d|]+)\|\n", text)
    assert sum(map(int, failed.split("|"))) == 72


@pytest.fixture
def seeds(several, tmp_path):
    """Two methods, two seeds each, whose trials are of their seed too."""
    runs = []
    for seed in (0, 1):
        for run in several[1:]:
            trials = [{**trial, "seed": seed} for trial in run.trials]
            settings = {**run.result["config"], "seed": seed}
            path = tmp_path / str(seed) / run.path.name
            labelled = run._replace(
                label=f"{run.label} (seed {seed})", path=path, log=path / "metrics.jsonl"
            )
            runs.append(edited(labelled, trials=trials, config=settings))
    return runs


def test_each_seed_is_compared_with_its_own(seeds):
    rows = tables.paired(seeds)[1:]
    said = [f"DP-RCM-4 (seed {i}), of STAR-Diff (seed {i})" for i in (0, 1)]
    assert [row[0] for row in rows] == said and {row[1] for row in rows} == {"72"}


def test_a_report_of_several_seeds_shows_all_of_them(seeds):
    assert captions.title(seeds) == "4 runs of 2 methods on peg transfer"
    assert "<dt>Seed</dt><dd>0; 1</dd>" in sections.facts(seeds)
    lines = figures.training(seeds).axes[0].lines
    assert len(lines) == 4 == len({(line.get_color(), line.get_linestyle()) for line in lines})
    shown = figures.distance(seeds, seeds[-1]).axes[0].lines
    drawn = [line for line in shown if not line.get_label().startswith("_")]
    assert len(drawn) == 4 == len({(x.get_color(), x.get_linestyle()) for x in drawn})


def test_curves_are_of_the_runs_own_training(one, tmp_path):
    """Not of what was trained beside a folder with another evaluation's result."""
    for name in ("stardiff", "packaged"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "result.json").write_text(json.dumps(one.result))
    (tmp_path / "stardiff" / "metrics.jsonl").write_text('{"step": 1}\n')
    assert results.load(tmp_path / "packaged").curves == []
    assert results.load(tmp_path / "stardiff").curves == [{"step": 1}]


def test_what_is_of_other_weights_is_left_out_and_said(tmp_path):
    path = synthetic.run(tmp_path / "stardiff", sweep_of=5)
    result = {**json.loads((path / "result.json").read_text()), "weights": "a"}
    files.write_json(path / "result.json", result)
    ms = {"p50": 1.0, "p95": 1.0, "p99": 1.0}
    files.write_json(path / "bench.json", {"weights": "b", "inference_ms_by_ddim_steps": {"2": ms}})
    run = results.load(path)
    assert run.sweep and run.curves and not run.bench and run.others == ("bench.json",)
    sweep = json.loads((path / "sweep.json").read_text())
    files.write_json(path / "sweep.json", {**sweep, "weights": "b"})
    trained = config.from_dict(config.RunConfig, result["config"])
    folders.claim(path, trained, "demos-a")
    assert results.load(path).curves
    longer = dataclasses.replace(trained, train=dataclasses.replace(trained.train, steps=7))
    folders.claim(path, longer, "demos-a")
    run = results.load(path)
    assert not run.sweep and not run.curves
    (note,) = [text for text in captions.notes([run]) if "other weights" in text]
    assert note.startswith("STAR-Diff: sweep.json and bench.json and metrics.jsonl beside")


def test_results_that_read_safety_otherwise_are_told_apart(one):
    errors = {k: v for k, v in one.result["rcm_error_mm"].items() if k != "within_steps"}
    old = edited(one, rcm_error_mm=errors)._replace(label="old")
    (note,) = [text for text in captions.notes([one, old]) if "safe" in text]
    assert note == "old: safe successes were read at the ends of control steps only."
    assert not [text for text in captions.notes([old]) if "safe" in text]


def test_a_report_leaves_nothing_of_the_one_before(tmp_path):
    out = tmp_path / "report"
    out.mkdir()
    for name in ("ports.png", "ports.pdf", "rollout.mp4", "mine.png"):
        (out / name).write_text("of before")
    build.build([synthetic.run(tmp_path / "stardiff")], out, with_video=False)
    kept = {path.name for path in out.iterdir() if path.is_file()}
    assert {"fig4.png", "index.html", "mine.png"} <= kept
    assert not kept & {"ports.png", "ports.pdf", "rollout.mp4"}


@pytest.mark.parametrize("fails", [(page, "render"), (style, "save"), (files, "write_bytes")])
def test_a_report_that_fails_leaves_the_one_before(tmp_path, monkeypatch, fails):
    def fail(*_):
        raise OSError("disk full")

    run, out = synthetic.run(tmp_path / "stardiff"), tmp_path / "report"
    build.build([run], out, with_video=False)
    (out / "rollout.mp4").write_text("of before")
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    monkeypatch.setattr(*fails, fail)
    with pytest.raises(OSError, match="disk full"):
        build.build([run], out, with_video=False)
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


def test_a_machine_without_a_video_encoder_still_gets_the_page(tmp_path, monkeypatch):
    def fail(*_):
        raise RuntimeError("no ffmpeg")

    said = []
    build.build([synthetic.run(tmp_path / "y")], tmp_path / "report", report=said.append)
    assert said.pop().startswith("no video: no trial was recorded") and not said
    monkeypatch.setattr(video, "record", fail)
    index = build.build([synthetic.run(tmp_path / "x")], tmp_path / "report", report=said.append)
    assert index.exists() and said == ["no video: no ffmpeg"]
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(RuntimeError, match="encoder is missing"):
        video.write([np.zeros((2, 2, 3), np.uint8)], tmp_path / "film.mp4")


def test_runs_trained_at_fewer_trocars_show_what_more_buy(tmp_path):
    paths = []
    for count in (1, 2, 8):
        path = synthetic.run(tmp_path / f"{count}" / "stardiff", skill=(1.0, 0.5))
        result = json.loads((path / "result.json").read_text())
        for trial in result["trials"]:
            trial["seen"] = trial["trocar"] < count
        (path / "result.json").write_text(json.dumps(result))
        paths.append(path)
    index = build.build(paths, tmp_path / "report", with_video=False)
    assert (tmp_path / "report" / "ports.png").stat().st_size > 1000
    assert "number of training trocars" in index.read_text()
    text = (tmp_path / "report" / "tables.md").read_text()
    assert all(f"STAR-Diff ({n})" in text for n in ("1 trocar", "2 trocars", "8 trocars"))
    runs = [results.load(path) for path in paths]
    assert ports.never_seen(runs) == {8, 9, 10, 11}
    assert [ports.trained_at(run) for run in runs] == [1, 2, 8]
    line = ports.draw(runs).axes[0].lines[0]
    expected = outcomes.tally(t for t in runs[0].trials if t["trocar"] >= 8).rate
    np.testing.assert_allclose(line.get_ydata(), expected)
    assert ports.draw(runs[1:2]) is None and ports.draw([runs[2], runs[2]]) is None


def test_a_note_of_some_runs_names_them(one):
    other = one._replace(label="DP-EE", result={"warnings": ["common", "its own"]})
    both = [one._replace(result={"warnings": ["common"]}), other]
    assert captions.notes(both) == ["common", "DP-EE: its own"]


def test_a_report_of_runs_that_were_trained_otherwise_says_in_what(one):
    policy = {**one.result["config"]["policy"], "sees_trocar": "never"}
    other = edited(one, config={**one.result["config"], "policy": policy})
    (*_, note) = captions.notes([one, other])
    assert note.startswith("These runs were not trained alike") and note.endswith(
        "in policy.sees_trocar."
    )
    assert captions.notes([one, one]) == one.result["warnings"]


def test_every_test_of_success_stands_under_its_own_name(one):
    header, row = tables.by_test([one])
    tests = {"Strict": outcomes.strict, "Loose": outcomes.loose, "Safe": outcomes.safe}
    for name, test in tests.items():
        for part, trials in zip(("seen", "unseen"), outcomes.split(one.trials)):
            said = row[header.index(f"{name}, {part}")]
            assert said == tables.rate(outcomes.tally(trials, test))


def test_intervals_are_written_from_low_to_high(one):
    score = stats.Rate(71, 96, 0.74, 0.644, 0.817)
    assert tables.rate(score) == "74.0 (71/96) [64.4, 81.7]"
    assert captions.interval(score) == "95% interval 64–82%"
    assert tables.points((0.135, -0.027, 0.299)) == "+13.5 [-2.7, +29.9]"
    low, high = (f"{100 * x:+.0f}" for x in one.result["generalization_gap_ci95"])
    assert f"95% interval {low} to {high}" in sections.cards(one)


def test_counts_on_the_page_stand_under_seen_and_unseen(one, several):
    def shown(text):
        rows = re.findall(r"<tr>(.*?)</tr>", text, re.S)
        return [found for row in rows if (found := re.findall(r"</b> (\d+/\d+)", row))]

    def counted(run, test):
        scores = (outcomes.tally(trials, test) for trials in outcomes.split(run.trials))
        return [f"{score.successes}/{score.trials}" for score in scores]

    tests = (outcomes.strict, outcomes.loose, outcomes.safe)
    assert shown(sections.tests(one)) == [counted(one, test) for test in tests]
    found = shown(sections.comparison(several))
    assert found == [counted(run, outcomes.strict) for run in several]


def test_failures_are_counted_under_their_own_names(one):
    found = outcomes.failures(one.trials)
    assert len(set(found.values())) > 1
    header, row = tables.failures([one])
    wanted = {outcomes.SHORT[key].capitalize(): str(n) for key, n in found.items()}
    assert dict(zip(header[1:], row[1:], strict=True)) == wanted
    bars = re.findall(r"<div>([^<]+)</div><span[^>]*><i[^>]*></i>(\d+)<", sections.failures([one]))
    assert bars == [(outcomes.FAILURES[key], str(n)) for key, n in found.items()]


def test_each_phase_is_told_with_its_compiling(one):
    header, row = tables.phases([one])
    assert header[1:4] == ["Collect", "Train", "Evaluate"]
    assert row[1:4] == ["2 min 22 s", "7 min 2 s", "2 min 13 s"]


def test_rows_of_trocars_are_their_own(one):
    rows = re.findall(r"<tr>(.*?)</tr>", sections.per_trocar(one), re.S)[1:]
    for group, row in zip(outcomes.by_trocar(one.trials), rows, strict=True):
        part = "seen" if group[0]["trocar"] < 8 else "unseen"
        middle = np.median([trial["steps"] for trial in group if trial["success"]])
        assert f"<td>{part}</td>" in row and f">{middle / env.CONTROL_HZ:.1f} s<" in row
    trial = {"radius": 0.02, "polar": np.pi / 2, "azimuth": np.pi / 6}
    assert outcomes.place(trial) == ("2 cm", "90°", "30°")


def test_ports_from_above_are_at_their_places_and_unseen_ones_orange(one):
    shown = figures.distance([one], one).axes[1].collections[0]
    groups = [group[0] for group in outcomes.by_trocar(one.trials)]
    wanted = [
        [1e3 * t["radius"] * np.sin(t["polar"]) * f(t["azimuth"]) for f in (np.cos, np.sin)]
        for t in groups
    ]
    np.testing.assert_allclose(shown.get_offsets(), wanted, atol=1e-3)
    orange = [colors.to_hex(edge) == style.FAILURE.lower() for edge in shown.get_edgecolors()]
    assert orange == [not trial["seen"] for trial in groups]


def test_the_map_weighs_ports_by_their_trials():
    axis, at = Figure().subplots(), np.array([[-5.0, 0.0], [5.0, 0.0]])
    shown = figures._heat(axis, at, np.array([1.0, 0.0]), np.array([3, 1]))
    assert shown.get_array()[80, 80] == pytest.approx(0.75)


def test_paths_of_seen_trocars_are_above_those_of_unseen_ones(one):
    figure = trajectories.draw([one], SIM)
    titles = [axis.get_title("left").split() for axis in figure.axes]
    assert [title[0] for title in titles] == ["Seen"] * 3 + ["Unseen"] * 3
    assert [int(title[2]) < 8 for title in titles] == [True] * 3 + [False] * 3
    keys = {key.get_label(): key.get_color() for key in figure.legends[0].legend_handles}
    assert (keys["success"], keys["failure"]) == (style.SUCCESS, style.FAILURE)


def test_recorded_rollouts_are_their_own(tmp_path):
    run = synthetic.run(tmp_path / "stardiff")
    file = run / "evaluation" / "recorded.npz"
    kept = files.read_npz(file)
    count, longest = kept["p_world_tip"].shape[:2]
    kept["qpos"] = np.broadcast_to(np.arange(count)[:, None, None], (count, longest, 2))
    files.write_npz(file, kept)
    for row, rollout in enumerate(results.load(run).rollouts):
        assert (rollout.qpos == row).all() and len(rollout.qpos) == kept["length"][row]
        assert rollout.target_peg == kept["target_peg"][row]
        np.testing.assert_array_equal(rollout.p_world_trocar, kept["p_world_trocar"][row])


def test_a_clip_that_is_cut_says_when_the_trial_ended(one, monkeypatch):
    said = []
    monkeypatch.setattr(video, "caption", lambda rows, w: said.append(rows) or np.zeros((2, w, 3)))
    rollout = one.rollouts[0]._replace(p_world_tip=np.zeros((450, 3)))
    list(video._clip(lambda *_: np.zeros((16, 2, 2, 3)), "m", rollout, ""))
    (_, (ended, _)), (_, (cut, _)) = said[-1]
    assert ended.endswith(", 15.0 s") and cut == "first 12 s shown"


def test_an_evaluation_within_a_methods_folder_is_no_run_of_it(tmp_path, monkeypatch):
    built = []
    monkeypatch.setattr(build, "build", lambda runs, out, **_: built.append(runs))
    run = synthetic.run(tmp_path / "all" / "stardiff")
    shutil.copytree(run, run / "evaluate-seed1-6x60s")
    assert report_command.main([str(run.parent)]) == 0
    assert built == [[run]]
