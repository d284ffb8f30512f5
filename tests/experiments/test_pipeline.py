"""The order of a run's stages, what is skipped, and how it stops. The stages are stubs."""

import dataclasses
import json
import os
import signal
import types

import fakes
import mistakes
import numpy as np
import pytest
import stubs
import synthetic

from starjax import config, methods
from starjax.data import normalizer
from starjax.experiments import demonstrations, folders, messages, pipeline, presets
from starjax.policies import packaged, policy_file
from starjax.policies import policy as policies
from starjax.runtime import files, signals
from starjax.training import loop


def test_a_damaged_result_of_another_method_is_one_line(tmp_path):
    (tmp_path / "dp_ee").mkdir()
    (tmp_path / "dp_ee" / "result.json").write_text("{")
    with mistakes.of(str(tmp_path), "dp_ee/result.json is damaged"):
        pipeline._report(tmp_path, ["stardiff"])


@pytest.fixture
def done(monkeypatch):
    """Stages replaced by stubs that write down their names."""
    calls = []

    def plan(settings, env):
        return pipeline.Path(settings.out) / "demos-a", lambda: calls.append("collect")

    def train(settings, name, demos, env, encoder):
        demos()
        calls.append(f"train {name}")

    monkeypatch.setattr(pipeline, "_environment", lambda settings: None)
    monkeypatch.setattr(demonstrations, "plan", plan)
    monkeypatch.setattr(demonstrations, "load", lambda _, root, collect, encoder: collect())
    monkeypatch.setattr(pipeline, "_train", train)
    monkeypatch.setattr(pipeline, "_evaluate", lambda c, name, *_: calls.append(f"score {name}"))
    monkeypatch.setattr(pipeline, "_report", lambda out, names: calls.append("report"))
    return calls


def smoke(out, method):
    return dataclasses.replace(presets.PRESETS["smoke"], out=str(out), method=method)


def test_all_collects_once_trains_six_and_scores_eight(tmp_path, done):
    pipeline.run(smoke(tmp_path, "all"), pipeline.STAGES, "")
    trained = [call for call in done if call.startswith("train")]
    assert done.count("collect") == 1 and done[0] == "collect" and done[-1] == "report"
    assert len(trained) == len(set(trained)) == 6
    assert done[7:-1] == [f"score {name}" for name in methods.METHODS]


@pytest.mark.parametrize(
    ("method", "weights"), [("dp_ee_proj", "dp_ee"), ("stardiff_single", "dp_rcm4")]
)
def test_a_method_without_weights_of_its_own_trains_the_others(tmp_path, done, method, weights):
    pipeline.run(smoke(tmp_path, method), pipeline.STAGES, "")
    assert done == ["collect", f"train {weights}", f"score {method}", "report"]
    assert (tmp_path / weights / "config.json").exists()
    assert (tmp_path / method / "config.json").exists()


def test_stages_can_end_early(tmp_path, done):
    pipeline.run(smoke(tmp_path, "stardiff"), ("collect",), "")
    pipeline.run(smoke(tmp_path, "stardiff"), ("collect", "train"), "")
    assert done == ["collect", "collect", "train stardiff"]


def test_a_folder_in_use_is_refused_early(tmp_path, done):
    with files.lock(tmp_path), pytest.raises(files.StorageError, match="in use"):
        pipeline.run(smoke(tmp_path, "stardiff"), pipeline.STAGES, "")
    assert not done


def test_a_folder_that_cannot_be_made_is_refused_early(tmp_path, done):
    (tmp_path / "file").touch()
    with pytest.raises(files.StorageError, match="file"):
        pipeline.run(smoke(tmp_path / "file" / "below", "stardiff"), pipeline.STAGES, "")
    assert not done


def test_a_mistaken_encoder_leaves_no_folder(tmp_path, done):
    image = dataclasses.replace(
        presets.PRESETS["smoke"].policy, observation="image", encoder_weights="nowhere"
    )
    wanted = dataclasses.replace(smoke(tmp_path / "new", "stardiff"), policy=image)
    with mistakes.of("policy.encoder_weights", "nowhere"):
        pipeline.run(wanted, pipeline.STAGES, "")
    assert not done and not (tmp_path / "new").exists()


def test_weights_that_are_kept_are_the_average(tmp_path, monkeypatch):
    stats = normalizer.Normalizer(normalizer.MinMax(-np.ones(5), np.ones(5)), None)
    raw, average = {"w": np.zeros(3)}, {"w": np.ones(3)}
    state = types.SimpleNamespace(params=raw, ema_params=average, normalizer=stats)
    monkeypatch.setattr(loop, "run", lambda *_, **__: loop.Result(state, 1.0, 0, {}))
    env = fakes.env()
    pipeline._train(smoke(tmp_path, "stardiff"), "stardiff", lambda: None, env, None)
    kept = policy_file.load(folders.weights(tmp_path, "stardiff"))
    np.testing.assert_array_equal(kept.params["w"], np.ones(3))


@pytest.mark.parametrize("number", signals.STOPS)
def test_a_stop_during_the_last_steps_ends_the_run_after_the_weights(tmp_path, monkeypatch, number):
    stats = normalizer.Normalizer(normalizer.MinMax(-np.ones(5), np.ones(5)), None)
    state = types.SimpleNamespace(ema_params={"w": np.ones(3)}, normalizer=stats)

    def last_steps(*_, **__):
        os.kill(os.getpid(), number)
        return loop.Result(state, 1.0, 0, {})

    before = signal.signal(number, signal.default_int_handler)  # it may be ignored
    monkeypatch.setattr(loop, "run", last_steps)
    env = fakes.env()
    with pytest.raises(KeyboardInterrupt, match=r"stopped after training stardiff;.*same command"):
        pipeline._train(smoke(tmp_path, "stardiff"), "stardiff", lambda: None, env, None)
    signal.signal(number, before)
    assert folders.weights(tmp_path, "stardiff").exists()


def test_plan_names_the_observation_and_the_flag(tmp_path):
    preset = presets.PRESETS["smoke"]
    said = messages.plan(preset, pipeline.STAGES)
    assert "state" in said and "--policy.observation image" in said and "preset smoke" in said
    policy = dataclasses.replace(preset.policy, observation="image")
    said = messages.plan(dataclasses.replace(preset, policy=policy), pipeline.STAGES)
    assert "image, 64 px" in said and "from scratch" in said and "state" not in said


def test_plan_says_where_devices_cannot_share_a_batch(monkeypatch):
    smoke = presets.PRESETS["smoke"]
    assert "devices" not in messages.plan(smoke, pipeline.STAGES)
    monkeypatch.setattr("jax.device_count", lambda: 8)
    monkeypatch.setattr(
        "starjax.training.devices.make_mesh", lambda _: types.SimpleNamespace(size=5)
    )
    assert "on 5 of 8 devices" in messages.plan(smoke, pipeline.STAGES)
    assert "on 5 of 8 devices" not in messages.plan(smoke, ("collect",))


def test_plan_and_warnings_say_that_an_encoder_is_frozen():
    cpu = presets.PRESETS["cpu"]
    said = "frozen, from compact (pretrained on this task); small"
    assert f"  encoder         {said}\n" in messages.plan(cpu, pipeline.STAGES)
    found = messages.warnings(cpu, {"method": "stardiff", "invalid": 0})
    assert found == [f"Image encoder: {said}, 128 px."]


def test_an_encoder_that_learns_further_names_its_beginning(tmp_path):
    path = str(tmp_path / "resnet18.safetensors")
    policy = config.PolicyConfig(encoder_weights=path)
    assert messages.encoder(policy) == f"trained further, from {path}"


def test_a_packaged_encoder_is_of_this_task(tmp_path, monkeypatch):
    policy = config.PolicyConfig(encoder_weights="compact")
    made = fakes.trained(method="dp_rcm2", policy=policy, params={"unet": np.ones(3)})
    monkeypatch.setattr(packaged, "FOLDER", tmp_path)
    assert messages.encoder(policy) == "trained further, from compact"
    policy_file.save(tmp_path / "compact.safetensors", made)
    assert messages.encoder(policy) == "trained further, from compact (pretrained on this task)"


def test_a_wrong_encoder_is_found_before_anything_is_collected(tmp_path, done):
    preset = smoke(tmp_path, "stardiff")
    policy = dataclasses.replace(
        preset.policy, observation="image", encoder_weights="nowhere", freeze_encoder=True
    )
    with mistakes.of("policy.encoder_weights", "nowhere"):
        pipeline.run(dataclasses.replace(preset, policy=policy), pipeline.STAGES, "")
    assert not done


def test_a_finished_run_needs_its_encoder_no_more(tmp_path, done):
    preset = smoke(tmp_path, "stardiff")
    policy = dataclasses.replace(
        preset.policy, observation="image", encoder_weights="nowhere", freeze_encoder=True
    )
    settings = dataclasses.replace(preset, policy=policy)
    folders.claim(tmp_path / "stardiff", settings, "demos-a", "abcd")
    (tmp_path / "stardiff" / "policy.safetensors").touch()
    pipeline.run(settings, pipeline.STAGES, "")
    assert done[-2:] == ["score stardiff", "report"]


def test_a_result_of_other_trials_is_not_taken_for_done(tmp_path):
    smoke = dataclasses.replace(presets.PRESETS["smoke"], seed=0)
    synthetic.run(tmp_path / "stardiff")
    file = tmp_path / "stardiff" / "result.json"
    result = {**files.read_json(file), "config": _json(smoke), "seed": 0, "weights": "a"}

    def is_done(found, wanted=smoke, weights="a"):
        file.write_text(found if isinstance(found, str) else json.dumps(found))
        found = pipeline._scored(file.parent, weights)
        return bool(found) and pipeline._is_of(found, wanted)

    assert is_done(result) and not is_done(result, weights="b")
    older = json.loads(json.dumps(result))
    del older["config"]["policy"]["freeze_encoder"], older["config"]["scene"]
    older["config"]["demos"]["one_wall"] = False
    del older["config"]["demos"]["expert"]
    assert is_done(older)
    assert not is_done({**result, "seed": 1})  # of `starjax evaluate --out`
    more = dataclasses.replace(smoke, eval=dataclasses.replace(smoke.eval, trials=9))
    assert not is_done(result, more)
    other = dataclasses.replace(smoke, scene=config.SceneConfig(task="reach"))
    assert not is_done(result, other)
    for damaged in ("{", "{}", '{"config": 1}', '{"config": {"of": "another"}, "trials": []}'):
        assert not is_done(damaged)


def test_more_trials_than_asked_for_are_not_thrown_away(tmp_path):
    preset = smoke(tmp_path, "stardiff")
    synthetic.run(tmp_path / "stardiff", trials=2)
    folder = tmp_path / "stardiff"
    (folder / "policy.safetensors").write_bytes(b"weights")
    weights = files.sha256(folder / "policy.safetensors")
    settings = _json(preset)
    settings["eval"]["trials"] = 2
    files.write_json(
        folder / "result.json",
        {**files.read_json(folder / "result.json"), "config": settings, "weights": weights},
    )
    many = files.read_json(folder / "result.json")
    with mistakes.of("eval.trials", preset.eval.trials) as told:
        pipeline._evaluate(preset, "stardiff", stubs.make_env(), "demos-a", "")
    assert f"starjax evaluate {folder}" in told.value.hint
    assert files.read_json(folder / "result.json") == many


def test_a_twins_trials_are_not_run_again(tmp_path, monkeypatch):
    from starjax.experiments import policy_under_test

    preset = smoke(tmp_path, "stardiff_single")
    for name in ("dp_rcm4", "stardiff_single"):
        (tmp_path / name).mkdir()
    (tmp_path / "dp_rcm4" / "policy.safetensors").write_bytes(b"weights")
    (tmp_path / "dp_rcm4" / "evaluation").mkdir()
    (tmp_path / "dp_rcm4" / "evaluation" / "chunk_0000.npz").write_bytes(b"trials")
    found = []
    monkeypatch.setattr(policy_under_test, "load", lambda *_: None)
    monkeypatch.setattr(
        policy_under_test, "rollouts", lambda at, *_: found.extend(at.glob("*.npz"))
    )
    monkeypatch.setattr(policy_under_test, "write_result", lambda *_, **__: None)
    pipeline._evaluate(preset, "stardiff_single", stubs.make_env(), "demos-a", "")
    assert found == [tmp_path / "stardiff_single" / "evaluation" / "chunk_0000.npz"]


def _json(settings):
    return config.as_json(settings)


def test_warnings_name_what_a_reader_must_know():
    figures = {"method": "stardiff", "invalid": 2}
    smoke_words = " ".join(messages.warnings(presets.PRESETS["smoke"], figures))
    assert "not pixels" in smoke_words and "too short" in smoke_words and "2 trial" in smoke_words
    (paper,) = messages.warnings(config.RunConfig(), {**figures, "invalid": 0})
    assert "Image encoder: trained from scratch; resnet18, 256 px" in paper


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

    def said(method):
        settings = config.RunConfig(method=method, policy=policy)
        (_, *found) = messages.warnings(settings, {"method": method, "invalid": 0})
        return found, messages.plan(settings, ()).count(f"(--policy.{flag})")

    assert said(leaves) == ([], 0)
    (warning,), planned = said(changes)
    assert warning.startswith("Ablation: ") and f"(--policy.{flag})" in warning and planned == 1
    everything = config.RunConfig(method="all", policy=policy)
    assert f"(--policy.{flag})" in messages.plan(everything, ())


def test_the_ablation_of_the_frame_is_named_for_those_that_have_one():
    policy = config.PolicyConfig(trocar_yaw="fixed")
    named = {name for name in methods.METHODS if messages._ablations(name, policy)}
    assert named == {
        name for name, row in methods.METHODS.items() if policies.ablated(row, policy) != row
    }


def test_seen_comes_before_unseen_in_the_outcome():
    def rate(successes, trials):
        found = {"successes": successes, "trials": trials, "rate": successes / trials}
        return {**found, "ci95": [0.0, 1.0]}

    figures = {
        "seen": rate(1, 8),
        "unseen": rate(2, 4),
        "safe": {"all": rate(3, 12)},
        "rcm_error_mm": {"executed": {"mean": 0.1, "max": 0.2}},
    }
    result = types.SimpleNamespace(method="stardiff", figures=figures)
    head, row = messages.outcome([result]).splitlines()
    assert row.index("1/8") == head.index(" seen") + 1
    assert row.index("2/4") == head.index("unseen")
    assert row.index("3/12") == head.index("safe")


def test_a_policy_says_what_it_learned_from(tmp_path, monkeypatch):
    stats = normalizer.Normalizer(normalizer.MinMax(-np.ones(5), np.ones(5)), None)
    state = types.SimpleNamespace(ema_params={"w": np.ones(3)}, normalizer=stats)
    monkeypatch.setattr(loop, "run", lambda *_, **__: loop.Result(state, 1.0, 0, {}))
    settings, env = smoke(tmp_path, "stardiff"), stubs.make_env()
    pipeline._train(settings, "stardiff", lambda: None, env, None)
    kept = policy_file.load(folders.weights(tmp_path, "stardiff"))
    assert (kept.method, kept.preset, kept.demos) == ("stardiff", "smoke", settings.demos)
    assert (kept.policy, kept.train) == (settings.policy, settings.train)
    assert kept.scene == env.names and kept.roll_zero == (0.0,)
    np.testing.assert_array_equal(kept.p_world_ref, env.p_world_ref)


def test_times_of_a_result_are_of_the_weights_that_it_has(tmp_path):
    spent = {"collect demos-a": 1.0, "collect demos-b": 2.0, "train dp_ee": 3.0}
    spent |= {"train dp_ee: compile": 4.0, "train stardiff": 5.0, "evaluate dp_ee_proj": 6.0}
    files.write_json(tmp_path / "timings.json", spent)
    assert pipeline._timings(tmp_path, "dp_ee_proj", "demos-a") == {
        "collect": 1.0, "train": 3.0, "train: compile": 4.0, "evaluate": 6.0
    }  # fmt: skip


def test_the_outcome_has_intervals_and_the_worst_within_steps():
    rate = {"successes": 1, "trials": 4, "rate": 0.25, "ci95": [0.1, 0.6]}
    errors = {"executed": {"mean": 0.1, "max": 0.2}, "within_steps": {"max": 0.3}}
    figures = {"seen": rate, "unseen": rate, "safe": {"all": rate}, "rcm_error_mm": errors}
    result = types.SimpleNamespace(method="stardiff", figures=figures)
    (_, row) = messages.outcome([result]).splitlines()
    assert row.count("1/4 = 25% [10, 60]") == 3 and row.endswith("0.100 mm, at most 0.30")
