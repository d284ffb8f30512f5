"""The whole command at its smallest, as a user types it, and its files.

Task and arm are of other packages, `tests/extension/site` and the page on arms: from the expert to
the report.
"""

import json
import os
import pathlib
import re
import subprocess
import sys

import gantry
import numpy as np
import pytest

from starjax.data import load
from starjax.policies import policy_file

SITE = pathlib.Path(__file__).parents[1] / "extension" / "site"
TINY = ["--task", "touch", "--arm", "gantry", "--preset", "smoke", "--demos.seen-trocars", "4"]
TINY += ["--train.steps", "20", "--eval.time-limit-s", "2"]


@pytest.fixture(scope="module")
def starjax(tmp_path_factory):
    """Runs a command as a user does, with both packages installed."""
    arms = tmp_path_factory.mktemp("site")
    gantry.install(arms)
    # A real terminal's environment: nothing that the tests have set up but the device.
    kept = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    path = os.pathsep.join([str(SITE), str(arms), *filter(None, sys.path)])

    def run(*words: str) -> subprocess.CompletedProcess:
        return subprocess.run(
            [sys.executable, "-m", "starjax", *words],
            capture_output=True,
            text=True,
            timeout=1500,
            env={**kept, "JAX_PLATFORMS": "cpu", "PYTHONPATH": path},
        )

    return run


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    return tmp_path_factory.mktemp("run") / "out"


@pytest.fixture(scope="module")
def said(starjax, out):
    command = ["run", "--method", "stardiff", "--out", str(out), *TINY]
    first = starjax(*command)
    assert first.returncode == 0, first.stderr
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*.npz")}
    again = starjax(*command)
    assert again.returncode == 0, again.stderr
    assert before and before == {path: path.stat().st_mtime_ns for path in out.rglob("*.npz")}
    return first, again


def test_every_stage_speaks_and_the_table_comes_last(said, out):
    first, _ = said
    stages = re.findall(r"^\[\d/4\] (\w+)", first.stdout, re.M)
    assert stages == ["collect", "train", "evaluate", "report"]
    assert re.search(r"STAR-Diff +\d+/4 = .* \d+/8 = ", first.stdout)
    assert str(out / "report" / "index.html") in first.stdout
    assert "Traceback" not in first.stderr and "Warning" not in first.stderr


def test_the_same_command_again_does_nothing_twice(said):
    _, again = said
    assert again.stdout.count("already complete") == 2 and "Training" not in again.stderr


def test_result_holds_what_is_documented(said, out):
    result = json.loads((out / "stardiff" / "result.json").read_text())
    assert result["method"] == "stardiff" and result["observation"] == "state"
    assert result["scene"]["task"] == "touch" and result["scene"]["arms"] == ["gantry"]
    assert (result["seen"]["trials"], result["unseen"]["trials"]) == (4, 8)
    for part in (result["seen"], result["unseen"], result["safe"]["all"]):
        assert part["ci95"][0] <= part["rate"] <= part["ci95"][1]
        assert part["rate"] == part["successes"] / part["trials"]
    gap = result["seen"]["rate"] - result["unseen"]["rate"]
    assert result["generalization_gap"] == pytest.approx(gap)
    assert result["rcm_error_mm"]["commanded"]["max"] < 1e-2
    assert {"mean", "p99", "max"} <= result["rcm_error_mm"]["executed"].keys()
    assert 0 < result["inference_ms"]["p50"] <= result["inference_ms"]["p99"]
    assert result["seed"] == result["config"]["seed"] == 0
    assert len(result["trials"]) == 12 and len(result["per_trocar"]) == 12
    assert result["config"]["train"]["steps"] == 20 and result["config"]["preset"] == "smoke"
    assert {"collect", "train", "evaluate", "train: compile"} <= result["timings_s"].keys()
    assert result["command"].startswith("starjax run --method stardiff")
    assert any("not pixels" in text for text in result["warnings"])
    assert result["versions"]["jax"] and result["hardware"]["cores"] >= 1


def test_report_and_weights_are_there(said, out):
    page = (out / "report" / "index.html").read_text()
    assert "STAR-Diff" in page and "state" in page and "touched the mark" in page
    assert (out / "report" / "tables.md").read_text().count("|") > 20
    (demos,) = out.glob("demos-*")
    assert load.load(demos).description["scene"]["task"] == "touch"
    trained = policy_file.load(out / "stardiff" / "policy.safetensors")
    assert trained.policy.observation == "state" and trained.scene.task == "touch"
    lines = (out / "stardiff" / "metrics.jsonl").read_text().splitlines()
    assert all(np.isfinite(json.loads(line).get("loss", 0.0)) for line in lines)


def test_another_setting_in_the_same_folder_is_refused(starjax, said, out):
    changed = ["run", "--out", str(out), *TINY, "--train.batch-size", "8"]
    done = starjax(*changed)
    assert done.returncode == 2 and "Traceback" not in done.stderr
    assert "--train.batch-size" in done.stderr and "--out" in done.stderr


def test_commands_on_a_finished_run(starjax, said, out):
    run = str(out / "stardiff")
    bench = starjax("bench", run, "--ddim-steps", "1", "2", "--calls", "5")
    assert bench.returncode == 0, bench.stderr
    timed = json.loads((out / "stardiff" / "bench.json").read_text())
    assert timed["inference_ms_by_ddim_steps"].keys() == {"1", "2"}
    assert timed["roll_network_ms"]["p50"] > 0
    drawn = starjax("report", run, "--no-video", "--out", str(out / "again"))
    assert drawn.returncode == 0, drawn.stderr
    assert (out / "again" / "index.html").exists()


@pytest.mark.parametrize("command", ["evaluate", "sweep", "bench", "report"])
def test_a_folder_without_a_run_is_one_line(starjax, command, tmp_path):
    done = starjax(command, str(tmp_path))
    assert done.returncode == 2 and len(done.stderr.strip().splitlines()) == 1
