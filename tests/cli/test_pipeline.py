"""The order of a run's stages, skipped ones, and stops. The stages are stubs."""

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

from starjax.cli import demonstrations, folders, pipeline, presets, scenes, scored
from starjax.core import config, config_json, methods
from starjax.data import normalizer
from starjax.policies import in_env, policy_file
from starjax.runtime import files, signals
from starjax.sim.rollouts import sharing
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

    def plan(settings, env, share):
        root = pipeline.Path(settings.out) / "demos-a"
        return demonstrations.DemosWork(root, lambda: calls.append("collect"))

    def train(work, name, demos, compiled):
        demos()
        calls.append(f"train {name}")

    monkeypatch.setattr(pipeline, "_environment", lambda settings: None)
    monkeypatch.setattr(pipeline.precompile, "begin", lambda *_: pipeline.precompile.Precompiled())
    monkeypatch.setattr(demonstrations, "plan", plan)
    monkeypatch.setattr(demonstrations, "load", lambda config, env, root, collect, *_: collect())
    monkeypatch.setattr(pipeline, "_train", train)
    monkeypatch.setattr(pipeline, "_evaluate", lambda _, name, *__: calls.append(f"score {name}"))
    monkeypatch.setattr(pipeline, "_report", lambda out, names: calls.append("report"))
    return calls


def smoke(out, method):
    return dataclasses.replace(presets.PRESETS["smoke"], out=str(out), method=method)


def started(settings, env):
    """A run of these settings in an environment that is built already."""
    work = pipeline.RunContext(settings, None, sharing.ALONE, "")
    work.__dict__["env"] = env
    return work


def test_all_collects_once_trains_six_and_scores_eight(tmp_path, done):
    pipeline.run(smoke(tmp_path, "all"), pipeline.STAGES, "")
    trained = [call for call in done if call.startswith("train")]
    assert done.count("collect") == 1 and done[0] == "collect" and done[-1] == "report"
    assert len(trained) == len(set(trained)) == 6
    assert done[7:-1] == [f"score {name}" for name in methods.TABLE_II]


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
    raw, average = {"learner": {"w": np.zeros(3)}}, {"learner": {"w": np.ones(3)}}
    state = types.SimpleNamespace(params=raw, ema_params=average, normalizer=stats)
    monkeypatch.setattr(loop, "run", lambda *_, **__: loop.TrainingResult(state, 1.0, 0, {}))
    work = started(smoke(tmp_path, "stardiff"), fakes.env())
    pipeline._train(work, "stardiff", lambda: None)
    kept = policy_file.load(folders.weights(tmp_path, "stardiff"))
    np.testing.assert_array_equal(kept.params["learner"]["w"], np.ones(3))


@pytest.mark.parametrize("number", signals.STOPS)
def test_a_stop_during_the_last_steps_ends_the_run_after_the_weights(tmp_path, monkeypatch, number):
    stats = normalizer.Normalizer(normalizer.MinMax(-np.ones(5), np.ones(5)), None)
    state = types.SimpleNamespace(ema_params={"w": np.ones(3)}, normalizer=stats)

    def last_steps(*_, **__):
        os.kill(os.getpid(), number)
        return loop.TrainingResult(state, 1.0, 0, {})

    before = signal.signal(number, signal.default_int_handler)  # it may be ignored
    monkeypatch.setattr(loop, "run", last_steps)
    work = started(smoke(tmp_path, "stardiff"), fakes.env())
    with pytest.raises(KeyboardInterrupt, match=r"stopped after training stardiff;.*same command"):
        pipeline._train(work, "stardiff", lambda: None)
    signal.signal(number, before)
    assert folders.weights(tmp_path, "stardiff").exists()


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
    settings = scenes.resolved(dataclasses.replace(preset, policy=policy))
    folders.claim(tmp_path / "stardiff", settings, "demos-a", "abcd")
    (tmp_path / "stardiff" / "policy.safetensors").touch()
    pipeline.run(settings, pipeline.STAGES, "")
    assert done[-2:] == ["score stardiff", "report"]


def test_a_result_of_other_trials_is_not_taken_for_done(tmp_path):
    smoke = scenes.resolved(dataclasses.replace(presets.PRESETS["smoke"], seed=0))
    synthetic.run(tmp_path / "stardiff")
    file = tmp_path / "stardiff" / "result.json"
    result = {**files.read_json(file), "config": _json(smoke), "seed": 0, "weights": "a"}

    def is_done(found, wanted=smoke, weights="a"):
        file.write_text(found if isinstance(found, str) else json.dumps(found))
        found = scored._read(file.parent, weights)
        return bool(found) and scored._is_of(found, wanted)

    assert is_done(result) and not is_done(result, weights="b")
    older = json.loads(json.dumps(result))
    del older["config"]["policy"]["freeze_encoder"]
    assert is_done(older)
    assert not is_done({**result, "seed": 1})  # folder of `starjax evaluate --out`
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
        pipeline._evaluate(started(preset, stubs.make_env()), "stardiff", "demos-a")
    assert f"starjax evaluate {folder}" in told.value.hint
    assert files.read_json(folder / "result.json") == many


def test_a_twins_trials_are_not_run_again(tmp_path, monkeypatch):
    from starjax.cli import policy_evaluation

    preset = smoke(tmp_path, "stardiff_single")
    for name in ("dp_rcm4", "stardiff_single"):
        (tmp_path / name).mkdir()
    (tmp_path / "dp_rcm4" / "policy.safetensors").write_bytes(b"weights")
    (tmp_path / "dp_rcm4" / "evaluation").mkdir()
    (tmp_path / "dp_rcm4" / "evaluation" / "chunk_0000.npz").write_bytes(b"trials")
    found = []
    monkeypatch.setattr(policy_evaluation, "read", lambda _: None)
    monkeypatch.setattr(in_env, "place", lambda *_, **__: None)
    monkeypatch.setattr(
        policy_evaluation, "rollouts", lambda at, *_, **__: found.extend(at.glob("*.npz"))
    )
    monkeypatch.setattr(policy_evaluation, "write_result", lambda *_, **__: None)
    work = started(preset, stubs.make_env())
    pipeline._evaluate(work, "stardiff_single", tmp_path / "demos-a")
    assert found == [tmp_path / "stardiff_single" / "evaluation" / "chunk_0000.npz"]


def _json(settings):
    return config_json.as_json(settings)


def test_a_policy_says_what_it_learned_from(tmp_path, monkeypatch):
    stats = normalizer.Normalizer(normalizer.MinMax(-np.ones(5), np.ones(5)), None)
    state = types.SimpleNamespace(ema_params={"w": np.ones(3)}, normalizer=stats)
    monkeypatch.setattr(loop, "run", lambda *_, **__: loop.TrainingResult(state, 1.0, 0, {}))
    settings, env = smoke(tmp_path, "stardiff"), stubs.make_env()
    trained = dataclasses.replace(settings.policy, dtype="bfloat16")
    trains = dataclasses.replace(settings, policy=trained)
    pipeline._train(started(trains, env), "stardiff", lambda: None)
    kept = policy_file.load(folders.weights(tmp_path, "stardiff"))
    assert (kept.method, kept.preset, kept.demos) == ("stardiff", "smoke", settings.demos)
    assert settings.policy.dtype == "float32"  # in which it decides
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
