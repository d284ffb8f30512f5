"""Presets: starting values of a run, and which of them `auto` means."""

import dataclasses
import json
import pathlib

import pytest

from starjax.cli import presets, run_settings
from starjax.core import config, config_json, errors
from starjax.runtime import gpu

RESULTS = pathlib.Path(__file__).parents[2] / "experiments"


@pytest.mark.parametrize("guess", [False, True])
@pytest.mark.parametrize(("used", "preset"), [(False, "cpu"), (True, "gpu")])
def test_auto_is_what_jax_says_not_what_the_system_shows(monkeypatch, capsys, guess, used, preset):
    monkeypatch.setattr(gpu, "is_likely", lambda: guess)
    monkeypatch.setattr(gpu, "is_used", lambda: used)
    for argv in ([], ["--preset", "auto"]):
        found = run_settings.parse("run", [*argv, "--train.steps", "7"], "")
        assert (found.preset, found.out) == (preset, f"runs/{preset}") and found.train.steps == 7
        assert found.policy == presets.PRESETS[preset].policy
        said = capsys.readouterr().out
        assert said.count("\n") == 1 and said.startswith(f"preset auto: {preset}")


def test_a_mistake_is_told_before_jax_is_asked(monkeypatch):
    monkeypatch.setattr(gpu, "is_used", lambda: pytest.fail("jax was asked"))
    with pytest.raises(errors.UsageError):
        run_settings.parse("run", ["--train.steps", "0"], "")
    assert run_settings.parse("run", ["--preset", "smoke"], "").preset == "smoke"


def test_paper_preset_is_the_default_configuration():
    paper = presets.PRESETS["paper"]
    assert dataclasses.replace(paper, preset="auto") == config.RunConfig()
    assert (paper.train.steps, paper.train.batch_size) == (100_000, 256)


@pytest.mark.parametrize("name", presets.TIMINGS)
def test_a_presets_time_is_that_of_a_committed_result(name):
    timing, preset = presets.TIMINGS[name], presets.PRESETS[name]
    found = json.loads((RESULTS / timing.source).read_text())
    stages = sum(seconds for stage, seconds in found["timings_s"].items() if ":" not in stage)
    assert stages < timing.seconds < stages + 90  # start, compilers, report
    run = config_json.from_dict(config.RunConfig, found["config"])
    same = dataclasses.replace(preset, scene=run.scene)
    assert (
        config_json.weight_settings(run) == config_json.weight_settings(same)
        and run.eval == preset.eval
    )
    assert found["hardware"]["backend"] == timing.backend


@pytest.mark.parametrize("name", presets.PRESETS)
def test_configuration_survives_json(name):
    values = config_json.as_json(presets.PRESETS[name])
    assert config_json.from_dict(config.RunConfig, values) == presets.PRESETS[name]
    with pytest.raises(ValueError, match="stepps"):
        config_json.from_dict(config.TrainConfig, {"stepps": 1})


def test_a_setting_that_is_no_more_is_named():
    now = config_json.as_json(config.RunConfig())
    other = now | {"policy": now["policy"] | {"frame": "camera"}}
    assert config_json.differing_settings([other, now]) == ["policy.frame"]
    with pytest.raises(ValueError, match="frame"):
        config_json.from_dict(config.RunConfig, other)
