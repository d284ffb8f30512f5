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
