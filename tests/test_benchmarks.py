"""Benchmarks run, one with what a state carries on a GPU, which a run on a CPU would not see."""

import json
import sys

import pytest

from starjax import rcm
from starjax.models.kernels import packed_params
from starjax.runtime import provenance


@pytest.mark.slow
def test_the_training_step_is_timed(monkeypatch, capsys, pytestconfig):
    monkeypatch.setattr(packed_params, "PLATFORMS", {"cpu"})
    monkeypatch.syspath_prepend(pytestconfig.rootpath / "benchmarks")
    monkeypatch.setattr(sys, "argv", ["bench_train.py", "--tiny"])
    import bench_train  # from the folder of benchmarks, which is no package

    bench_train.main()
    row = capsys.readouterr().out.split("48 px")[1].split()
    samples, milliseconds, floor = map(float, row[:3])
    assert floor > 0
    assert abs(samples * milliseconds / 4e3 - 1) < 0.05  # batches of four


@pytest.mark.slow
def test_the_peers_of_all_action_spaces_compute_the_same(monkeypatch, capsys, pytestconfig):
    monkeypatch.syspath_prepend(pytestconfig.rootpath / "benchmarks")
    monkeypatch.setattr(sys, "argv", ["bench_rcm.py", "--tiny"])
    import bench_rcm

    bench_rcm.main()
    rows = [line.split() for line in capsys.readouterr().out.splitlines() if "code " in line]
    assert {row[0] for row in rows} == set(rcm.ACTION_SPACES) and len(rows) == 14
    assert max(float(row[-1]) for row in rows) < 1e-6


@pytest.mark.parametrize("arm", ["panda", "iiwa14"])
def test_seven_joints_do_not_drift_from_lap_to_lap(arm, monkeypatch, pytestconfig):
    monkeypatch.syspath_prepend(pytestconfig.rootpath / "benchmarks")
    import bench_nullspace

    gain = bench_nullspace.registries.arms.get(arm).rest_gain
    drift, residual = bench_nullspace.laps(arm, gain)
    assert drift <= 1e-6 and residual < 1e-5


def test_a_row_of_a_result_keeps_the_code_and_command_that_made_it(
    monkeypatch, tmp_path, pytestconfig
):
    monkeypatch.syspath_prepend(pytestconfig.rootpath / "benchmarks")
    import _timing

    monkeypatch.setattr(_timing, "RESULTS", tmp_path)
    for commit, row in (("a" * 40, "one"), ("b" * 40, "two"), ("c" * 40, "one")):
        code = provenance.Code("0", commit, dirty=False)
        monkeypatch.setattr(_timing.provenance, "code", lambda code=code: code)
        monkeypatch.setattr(sys, "argv", ["/elsewhere/bench_x.py", "--only", row])
        path = _timing.write("x", {"results": {row: {"ms": 1.0}}})
    found = json.loads(path.read_text())
    assert set(found["results"]) == {"one", "two"}
    assert [found["made"][row]["commit"][0] for row in ("one", "two")] == ["c", "b"]
    assert found["made"]["two"]["command"] == "python benchmarks/bench_x.py --only two"


def test_tables_of_fine_tunings_say_when_no_round_is_better(tmp_path, monkeypatch, pytestconfig):
    monkeypatch.syspath_prepend(pytestconfig.rootpath / "benchmarks")
    import finetuned

    def rate(won):
        return {"successes": won, "trials": 10, "rate": won / 10, "ci95": [0.0, 1.0]}

    found = {
        "by": "dagger",
        "command": "starjax finetune runs/a --by dagger --out runs/b",
        "rounds": [
            {"round": 0},
            {
                "round": 1,
                "branches": {"takeover": 3, "1 s": 2},
                "not_rescued": {"lost": [[0, 1]], "stalled": [[0, 2], [1, 3]]},
            },
        ],
        "best": 0,
        "before": {"seen": rate(8), "unseen": rate(7)},
        "timings_s": {"before": 60.0, "before: compile": 40.0},
        "hardware": {"backend": "cpu", "cpu": "a CPU", "cores": 2},
    }
    (tmp_path / "finetune_a.json").write_text(json.dumps(found))
    better = {**found, "best": 1, "after": {"seen": rate(9), "unseen": rate(10)}}
    (tmp_path / "finetune_b.json").write_text(json.dumps(better))
    begun = {name: found[name] for name in ("command", "rounds")}
    (tmp_path / "finetune_c.json").write_text(json.dumps(begun))
    _, _, kept, improved = finetuned.ways(tmp_path).splitlines()
    assert "`runs/a --by dagger`" in kept and "none is better" in kept
    assert kept.count("8/10") == 2 and "9/10" in improved and "10/10" in improved
    assert finetuned.branches(tmp_path).count("| 3 | 2 | 3 |") == 3
