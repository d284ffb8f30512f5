"""Messages of a run: plan, warnings, outcome. Facts and numbers, not sentences."""

import dataclasses
import types

import fakes
import numpy as np
import pytest

from starjax.cli import messages, plan_text, presets
from starjax.core import config, methods
from starjax.policies import packaged, policy_file
from starjax.policies import policy as policies

SMOKE = presets.PRESETS["smoke"]
NONE_INVALID = {"method": "stardiff", "invalid": 0}


def test_the_plan_has_the_scene_the_observation_and_the_numbers():
    said = plan_text.plan(SMOKE, messages.STAGES)
    for fact in ("peg transfer", "state", "block.p", "8 (1 x 8", "40 steps of 32"):
        assert fact in said
    assert "12 trocars x 1 trials" in said and "--policy.observation image" in said
    policy = dataclasses.replace(SMOKE.policy, observation="image")
    said = plan_text.plan(dataclasses.replace(SMOKE, policy=policy), messages.STAGES)
    assert "image, 64 px" in said and "from scratch" in said and "state" not in said


@pytest.mark.parametrize(("limit_s", "is_short"), [(28.0, True), (29.0, False)])
def test_a_plan_says_if_trials_end_before_demonstrations_do(limit_s, is_short):
    scene = dataclasses.replace(SMOKE.scene, task="endoscope_track")
    trials = dataclasses.replace(SMOKE.eval, time_limit_s=limit_s)
    said = plan_text.plan(dataclasses.replace(SMOKE, scene=scene, eval=trials), messages.STAGES)
    assert ("--eval.time-limit-s" in said) == is_short


def test_the_plan_has_the_measured_time_of_an_unchanged_preset(monkeypatch):
    cpu = presets.PRESETS["cpu"]
    timing = presets.Timing("2 cores of a test", "cpu", 431.0, "result.json")
    monkeypatch.setitem(presets.TIMINGS, "cpu", timing)
    time = "7 min on 2 cores of a test"
    assert time in plan_text.plan(cpu, messages.STAGES)
    assert time in plan_text.plan(dataclasses.replace(cpu, seed=3, out="x"), messages.STAGES)
    steps = dataclasses.replace(cpu, train=dataclasses.replace(cpu.train, steps=7))
    assert time not in plan_text.plan(steps, messages.STAGES)
    assert time not in plan_text.plan(cpu, ("collect", "train"))


def test_the_plan_says_where_devices_cannot_share_a_batch(monkeypatch):
    assert "devices" not in plan_text.plan(SMOKE, messages.STAGES)
    monkeypatch.setattr("jax.device_count", lambda: 8)
    five = types.SimpleNamespace(size=5)
    monkeypatch.setattr("starjax.training.devices.make_mesh", lambda _: five)
    assert "on 5 of 8 devices" in plan_text.plan(SMOKE, messages.STAGES)
    assert "on 5 of 8 devices" not in plan_text.plan(SMOKE, ("collect",))


def test_an_encoder_says_where_it_began_and_for_which_task(tmp_path, monkeypatch):
    assert plan_text.encoder(presets.PRESETS["cpu"]).startswith("frozen, from compact (pretrained")
    settings = config.RunConfig(policy=config.PolicyConfig(encoder_weights="compact"))
    monkeypatch.setattr(packaged, "folders", lambda: [tmp_path])
    assert plan_text.encoder(settings) == "trained further, from compact"  # as of torchvision's
    made = fakes.trained(policy=settings.policy, params={"unet": np.ones(3)})
    policy_file.save(tmp_path / "compact.safetensors", made)
    assert "this task" in plan_text.encoder(settings)
    elsewhere = dataclasses.replace(settings, scene=config.SceneConfig(task="reach"))
    assert "peg_transfer" in plan_text.encoder(elsewhere)
    seen = config.SceneConfig(camera=("endoscope",))
    through = [
        plan_text.encoder(dataclasses.replace(settings, scene=scene))
        for scene in (seen, config.SceneConfig(camera=("camera",)))
    ]
    assert ["through camera" in text for text in through] == [True, False]


def test_warnings_name_what_a_reader_must_know():
    said = plan_text.warnings(SMOKE, {"method": "stardiff", "invalid": 2})
    assert [fact in text for fact, text in zip(("block.p", "smoke", "2 trial"), said)] == [True] * 3
    (paper,) = plan_text.warnings(config.RunConfig(), NONE_INVALID)
    assert "from scratch" in paper and "resnet18" in paper and "256 px" in paper


@pytest.mark.parametrize(
    ("switch", "flag", "changes", "leaves"),
    [
        ({"sees_trocar": "always"}, "sees-trocar always", "stardiff", "dp_rcm4"),
        ({"sees_trocar": "never"}, "sees-trocar never", "dp_rcm4", "stardiff"),
        ({"trocar_yaw": "fixed"}, "trocar-yaw fixed", "dp_rcm2", "dp_rcm4"),
        ({"roll_history": False}, "no-roll-history", "stardiff", "dp_rcm4"),
        ({"roll_trocar": False}, "no-roll-trocar", "stardiff", "dp_ee"),
        ({"roll_observation": True}, "roll-observation", "stardiff", "stardiff_single"),
    ],
)
def test_an_ablation_is_named_where_it_changes_the_method(switch, flag, changes, leaves):
    policy = config.PolicyConfig(**switch)
    for method, count in ((changes, 1), (leaves, 0), ("all", 1)):
        settings = config.RunConfig(method=method, policy=policy)
        assert plan_text.plan(settings, ()).count(f"(--policy.{flag})") == count
    for method, count in ((changes, 1), (leaves, 0)):
        _, *found = plan_text.warnings(
            config.RunConfig(policy=policy), {"method": method, "invalid": 0}
        )
        assert len(found) == count and all(f"(--policy.{flag})" in text for text in found)


def test_the_ablation_of_the_frame_is_named_for_those_that_have_one():
    policy = config.PolicyConfig(trocar_yaw="fixed")
    named = {name for name in methods.METHODS if plan_text._ablations(name, policy)}
    rows = methods.METHODS.items()
    assert named == {name for name, row in rows if policies.ablated(row, policy) != row}


def test_the_outcome_has_a_row_a_method_under_its_columns():
    def rate(successes, trials):
        found = {"successes": successes, "trials": trials, "rate": successes / trials}
        return {**found, "ci95": [0.1, 0.6]}

    rcm = {"executed": {"mean": 0.1, "max": 0.2}, "within_steps": {"max": 0.3}}
    figures = {"seen": rate(1, 8), "unseen": rate(2, 4), "safe": {"all": rate(3, 12)}}
    rows = [{**figures, "rcm_error_mm": errors} for errors in (rcm, {"executed": rcm["executed"]})]
    found = [types.SimpleNamespace(method="stardiff", figures=row) for row in rows]
    head, one, older = messages.outcome(found).splitlines()
    for column, cell in ((" seen", " 1/8 = 12% [10, 60]"), ("unseen", "2/4"), ("safe", "3/12")):
        assert one.index(cell) == head.index(column)
    # mean and maximum are of one measure, the ends of control steps
    assert one.endswith("0.100 mm, at most 0.200") and older.endswith("0.100 mm, at most 0.200")
