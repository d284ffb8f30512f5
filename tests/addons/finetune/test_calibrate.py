"""The command that adds a runtime monitor, and commands that read it. The simulator is a stub."""

import json

import mistakes
import numpy as np
import one_policy
import pytest

from starjax.addons.finetune.commands import calibrate
from starjax.cli import evaluate, stress
from starjax.policies import policy_file
from starjax.policies.monitor import scores

CALIBRATE = ["--policy=mine.safetensors", "--trials=120", "--time-limit-s=1", "--alpha=0.2"]


@pytest.fixture
def file(tmp_path, monkeypatch):
    return one_policy.stubbed(tmp_path, monkeypatch)


def test_a_calibrated_policy_is_scored_with_its_alarms(file, capsys):
    assert calibrate.main([*CALIBRATE, "--out=watched.safetensors", "--still-s=0.3"]) == 0
    (folder,) = (file.parent / "runs" / "calibrate").glob("mine-*-seed1-120x1s")
    content = json.loads((folder / "monitor.json").read_text())
    watched, plain = (policy_file.load(name) for name in ("watched.safetensors", file))
    monitor = watched.monitor
    assert monitor is not None and plain.monitor is None
    assert watched._replace(monitor=None)[:3] == plain[:3]
    assert (monitor.alpha, monitor.settings) == (0.2, (4, 30.0, 2))
    assert np.isfinite(monitor.limits).sum() == len(scores.CALIBRATED)
    assert content["monitor"]["count"] == monitor.count < 51
    assert content["test"]["false_alarms"]["trials"] + content["test"]["announced"]["trials"] == 51
    with mistakes.of("--out", "watched.safetensors"):
        calibrate.main([*CALIBRATE, "--out=watched.safetensors"])

    trials = ["--eval.trials=2", "--eval.time-limit-s=1", "--policy=watched.safetensors"]
    assert evaluate.main([*trials, "--out=scored"]) == 0
    result = json.loads((file.parent / "scored" / "result.json").read_text())
    successes = result["strict"]["all"]["successes"]
    assert result["alarms"]["false_alarms"]["trials"] == successes
    assert result["alarms"]["announced"]["trials"] == 24 - successes
    assert evaluate.main([*trials, "--out=averaged", "--eval.ensemble"]) == 0
    averaged = json.loads((file.parent / "averaged" / "result.json").read_text())
    assert "alarms" not in averaged
    offset = ["--disturbance", "trocar_offset", "--levels", "5", "--out", "wrong"]
    assert stress.main([*trials, *offset]) == 0
    stressed = json.loads((file.parent / "wrong" / "stress.json").read_text())
    level = stressed["disturbances"]["trocar_offset"]["levels"]["5"]
    assert level["alarms"]["false_alarms"]["trials"] == level["strict"]["successes"]
    assert "Alarms" in (file.parent / "wrong" / "stress.md").read_text()


def test_too_few_trials_write_no_policy(file):
    few = ["--trials=20", "--alpha=0.05", "--out=watched.safetensors"]
    with mistakes.of("trials", "for the scale"):
        calibrate.main([*CALIBRATE[:1], "--time-limit-s=1", *few])
    assert not (file.parent / "watched.safetensors").exists()
