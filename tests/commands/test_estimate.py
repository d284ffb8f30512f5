"""How long a run is said to take: as runs that were timed did."""

import dataclasses
import json
import pathlib

import pytest

from starjax import config
from starjax.commands import estimate, presets
from starjax.runtime import speed, xla

RESULTS = pathlib.Path(__file__).parents[2] / "experiments"
STAGES = ("collect", "train", "evaluate", "report")


@pytest.mark.parametrize("name", estimate.TIMED)
def test_what_was_timed_is_a_committed_result(name):
    timed = estimate.TIMED[name]
    found = json.loads((RESULTS / timed.source).read_text())
    demos, settings = found["config"]["demos"], found["config"]
    counts = {
        "collect": demos["per_trocar"] * demos["seen_trocars"],
        "features": demos["per_trocar"] * demos["seen_trocars"],
        "train": settings["train"]["steps"],
        "evaluate": 12 * settings["eval"]["trials"],
    }
    for stage, count in counts.items():
        figures = tuple(found["timings_s"].get(f"{stage}{part}") for part in ("", ": compile"))
        if figures != (None, None):
            assert getattr(timed, stage) == (count, *figures)
    assert found["method"] == "stardiff"
    run = config.from_dict(config.RunConfig, settings)
    usual = dataclasses.replace(presets.PRESETS[name], scene=run.scene)
    assert config.weight_settings(run) == config.weight_settings(usual) and run.eval == usual.eval
    assert found["hardware"]["backend"] == timed.backend


@pytest.mark.parametrize("name", estimate.TIMED)
def test_a_run_as_long_as_the_timed_one_takes_as_long(name):
    timed = estimate.TIMED[name]
    took = timed.collect.seconds + timed.features.seconds
    took += timed.train.seconds + timed.evaluate.seconds + timed.beside
    same = {"train": {"steps": timed.train.count}, "eval": {"trials": timed.evaluate.count // 12}}
    assert estimate.seconds(changed(name, **same), STAGES, 12) == pytest.approx(took)


def changed(preset="cpu", **parts):
    given = presets.PRESETS[preset]
    made = {part: dataclasses.replace(getattr(given, part), **new) for part, new in parts.items()}
    return dataclasses.replace(given, **made)


def test_more_of_anything_takes_longer_and_compiles_once():
    once = estimate.seconds(presets.PRESETS["cpu"], STAGES, 12)
    steps = 2 * presets.PRESETS["cpu"].train.steps
    more = {"demos": {"per_trocar": 60}, "train": {"steps": steps}, "eval": {"trials": 12}}
    for part, new in more.items():
        assert once < estimate.seconds(changed(**{part: new}), STAGES, 12) < 2 * once
    assert estimate.seconds(changed(**more), STAGES, 12) < 2 * once
    everything = dataclasses.replace(presets.PRESETS["cpu"], method="all")
    assert 3 * once < estimate.seconds(everything, STAGES, 12) < 8 * once


@pytest.mark.parametrize(
    "parts",
    [{"policy": {"horizon": 32}}, {"train": {"batch_size": 7}}, {"scene": {"task": "reach"}}],
)
def test_what_was_not_timed_is_not_known(parts):
    assert estimate.seconds(changed(**parts), STAGES, 12) is None
    assert "not known" in estimate.line(changed(**parts), STAGES, 12, "cpu", lambda: 1.0)
    assert "not known" in estimate.line(presets.PRESETS["cpu"], STAGES, 12, "gpu", lambda: 1.0)


def test_a_slower_machine_takes_longer():
    cpu = presets.PRESETS["cpu"]
    minutes = estimate.seconds(cpu, STAGES, 12) / 60
    for pace in (1.0, 3.0):
        said = estimate.line(cpu, STAGES, 12, "cpu", lambda pace=pace: pace)
        assert f"about {round(pace * minutes)} min here" in said and f"{round(minutes)} min" in said


def test_a_machine_is_as_fast_as_its_cores(monkeypatch):
    monkeypatch.setattr(xla, "cores", lambda: 2)
    here = speed.pace()
    assert 0.1 < here < 10
    monkeypatch.setattr(xla, "cores", lambda: 8)
    assert speed.pace() < 1.5 * here
    monkeypatch.setattr(xla, "cores", lambda: 1)
    assert 1.3 * here < speed.pace() < 3 * here
