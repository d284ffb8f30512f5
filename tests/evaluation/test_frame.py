"""Results as one table: a row per trial, and its columns against those of the trials."""

import csv

import mistakes
import numpy as np
import pytest
import synthetic

from starjax import evaluation
from starjax.evaluation import frame, result


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("runs")
    for seed, name in enumerate(("dp_rcm2", "stardiff")):
        synthetic.run(out / name, name, seed=seed, sweep_of=20 if seed else 0)
    return out


def test_a_row_is_a_trial(folder):
    rows = frame.rows(folder)
    read = [result.read(folder / name / "result.json") for name in ("dp_rcm2", "stardiff")]
    assert len(rows) == sum(len(one.trials) for one in read) == 144
    trial, row = read[1].trials[30], rows[72 + 30]
    assert (row["method"], row["label"], row["run"]) == (
        *("stardiff", "STAR-Diff"),
        str(folder / "stardiff"),
    )
    for name in ("trocar", "trial", "seed", "seen", "success", "safe", "steps", "rcm_max_mm"):
        assert row[name] == getattr(trial, name)
    assert row["seconds"] == trial.steps / 30.0 and row["source"] == trial.labels["source"]
    assert row["polar_deg"] == pytest.approx(np.degrees(trial.polar[0]), abs=1e-4)
    assert row["radius_mm"] == pytest.approx(1e3 * trial.radius[0], abs=1e-4)
    assert {row["polar_deg"] for row in rows} == {70.0, 80.0, 90.0, 100.0, 110.0}


def test_a_table_of_pandas_has_the_rates_of_the_result(folder):
    pytest.importorskip("pandas")
    table = evaluation.results([folder / "stardiff", folder / "dp_rcm2/result.json"])
    rates = table[table.seen].groupby("method").success.mean()
    for name in ("stardiff", "dp_rcm2"):
        seen = result.read(folder / name / "result.json").figures["seen"]
        assert rates[name] == pytest.approx(seen["rate"])


def test_files_are_read_once_and_sweeps_by_their_own_name(folder, tmp_path):
    assert len(frame.rows([folder, folder / "stardiff"])) == 144
    swept = frame.rows(folder / "stardiff" / "sweep.json")
    assert len(swept) == 20 and all(row["distance_mm"] >= 0 for row in swept)
    both = frame.rows([folder / "dp_rcm2", folder / "stardiff/sweep.json"])
    assert {len(row) for row in both} == {len(both[0])}
    with open(tmp_path / "t.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, list(both[0]))
        writer.writeheader()
        writer.writerows(both)
    assert len((tmp_path / "t.csv").read_text().splitlines()) == 1 + 72 + 20
    for path in (tmp_path, tmp_path / "none", ""):
        with mistakes.of("paths"):
            frame.rows(path)


def test_two_arms_have_a_column_each(folder):
    trial = result.read(folder / "stardiff" / "result.json").trials[0]
    row = frame._row(trial._replace(radius=(0.01, 0.02), polar=(1.0, 2.0), azimuth=(0, 1)), 30.0)
    assert (row["radius_mm_0"], row["radius_mm_1"], row["polar_deg_1"]) == (10.0, 20.0, 114.5916)
    assert "radius_mm" not in row


def test_without_pandas_the_rows_are_named(folder, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with mistakes.of("results") as caught:
        evaluation.results(folder)
    assert "frame.rows" in caught.value.hint


def test_paired_results_are_aligned_by_their_trials(folder):
    ours, theirs = (result.read(folder / name / "result.json") for name in ("stardiff", "dp_rcm2"))
    won = [(a.success, b.success) for a, b in zip(ours.trials, theirs.trials, strict=True)]
    counts = len(won), won.count((True, False)), won.count((False, True))
    found = result.paired(ours, theirs)
    assert found[:3] == counts and 0 < found.p <= 1
    shuffled = theirs._replace(trials=theirs.trials[::-1][:-5])
    back = result.paired(shuffled, ours)
    assert back.pairs == 67 and back[:3] != counts
    swapped = result.paired(theirs._replace(trials=theirs.trials[::-1]), ours)
    assert (swapped.only_b, swapped.only_a, swapped.p) == (counts[1], counts[2], found.p)
    assert result.paired(ours, theirs, "safe") != found
    for other in (
        theirs._replace(time_limit_s=1.0),
        theirs._replace(scene=theirs.scene._replace(task="reach")),
        theirs._replace(trials=tuple(t._replace(seed=9) for t in theirs.trials)),
    ):
        with mistakes.of("a, b"):
            result.paired(ours, other)
    with mistakes.of("test", "'won'"):
        result.paired(ours, theirs, "won")
