"""Benchmarks run, one with the carry of a GPU's state, absent on a CPU."""

import json
import sys

import pytest

from starjax import rcm
from starjax.policies.models.kernels import packed_params
from starjax.runtime import provenance


@pytest.mark.release
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


@pytest.mark.release
def test_the_peers_of_all_action_spaces_compute_the_same(monkeypatch, capsys, pytestconfig):
    monkeypatch.syspath_prepend(pytestconfig.rootpath / "benchmarks")
    monkeypatch.setattr(sys, "argv", ["bench_rcm.py", "--tiny"])
    import bench_rcm

    bench_rcm.main()
    rows = [line.split() for line in capsys.readouterr().out.splitlines() if "code " in line]
    straight = {name for name, space in rcm.ACTION_SPACES.items() if space.for_wrist is None}
    assert {row[0] for row in rows} == straight and len(rows) == 14
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


def test_a_fine_tuning_that_continues_another_is_one_with_it(finetunings):
    found, finetuned = finetunings
    import continued

    first = {**found, "best": 1, "after": 80}
    then = {**found, "weights": "d" * 64, "best": 1, "after": 85}
    (both,) = continued.joined({"a": first, "b": then}, {"a": ["b"], "other": ["c"]})
    assert both["weights"] == first["weights"] and both["before"] == first["before"]
    assert [row["round"] for row in both["rounds"]] == [0, 1, 2]
    assert both["best"] == 2 and both["after"] == 85
    assert finetuned.learning_seconds(both) == [0.0, 55.0, 110.0]
    (both,) = continued.joined({"a": first, "b": {**then, "best": 0}}, {"a": ["b"]})
    assert both["best"] == 1 and both["after"] == 80


def test_the_time_of_a_round_is_that_of_learning(finetunings):
    found, finetuned = finetunings
    assert finetuned.learning_seconds(found) == [0.0, 5.0 + 20.0 + 30.0]


@pytest.fixture
def finetunings(monkeypatch, pytestconfig):
    monkeypatch.syspath_prepend(pytestconfig.rootpath / "benchmarks")
    import finetuned

    found = {
        "weights": "e" * 64,
        "rounds": [
            {"round": 0},
            {"round": 1},
        ],
        "best": 0,
        "before": 70,
        "timings_s": {
            "round 0 validation": 60.0,
            "round 0 validation: compile": 40.0,
            "collect demos-1": 5.0,
            "round 1 rollouts": 20.0,
            "round 1 training": 30.0,
            "round 1 validation": 10.0,
        },
    }
    return found, finetuned
