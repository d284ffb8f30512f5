"""Commands that score trained weights. The simulator is a stub."""

import dataclasses
import html
import json

import fakes
import mistakes
import numpy as np
import one_policy
import pytest
import safetensors.numpy
import stubs
from one_policy import POLICY, unused

from starjax import rcm
from starjax.cli import (
    evaluate,
    folders,
    policy_args,
    policy_evaluation,
    presets,
    stress,
    sweep,
)
from starjax.core import config, config_json
from starjax.evaluation import sweep as sweeping
from starjax.policies import in_env, packaged, policy_file
from starjax.policies.base import Policy
from starjax.report import video
from starjax.runtime import files, gpu


@pytest.fixture
def file(tmp_path, monkeypatch):
    return one_policy.stubbed(tmp_path, monkeypatch)


def score(*more):
    trials = ["--eval.trials", "2", "--eval.time-limit-s", "1"]
    return evaluate.main(["--policy", "mine.safetensors", *trials, *more])


def test_a_file_alone_is_scored_by_its_own_settings(file, capsys):
    assert score() == 0
    (folder,) = (file.parent / "runs" / "evaluate").glob("mine-*-seed0-2x1s")
    result = json.loads((folder / "result.json").read_text())
    assert result["method"] == "dp_rcm2" and len(result["trials"]) == 24
    assert (result["seen"]["trials"], result["unseen"]["trials"]) == (8, 16)
    assert result["config"]["train"]["steps"] == 77 and result["preset"] == "smoke"
    assert result["config"]["policy"] == config_json.as_json(POLICY)
    assert result["timings_s"]["evaluate"] > 0
    assert any("Preset smoke" in text for text in result["warnings"])
    said = capsys.readouterr().out
    assert "/8 = " in said and "/16 = " in said and "rollout.mp4" in said


def test_a_packaged_policy_is_scored_by_its_name(file, monkeypatch, capsys):
    folder = file.parent / "weights"
    monkeypatch.setattr(packaged, "folders", lambda: [folder])
    folder.mkdir()
    file.rename(folder / "compact.safetensors")
    assert evaluate.main(["--policy", "compact", "--eval.trials=1", "--eval.time-limit-s=1"]) == 0
    said = capsys.readouterr().out
    assert "DP-RCM-2 of compact\n" in said and "into runs/evaluate/compact-seed0-1x1s\n" in said
    assert (file.parent / "runs" / "evaluate" / "compact-seed0-1x1s" / "result.json").is_file()
    assert [path.name for path in folder.iterdir()] == ["compact.safetensors"]


@pytest.mark.parametrize("guess", [False, True])
@pytest.mark.parametrize(("used", "trials"), [(False, 4), (True, 30)])
def test_how_many_trials_jax_decides_not_the_system(file, monkeypatch, guess, used, trials):
    def scored(folder, who, trocars, settings, seed):
        raise KeyboardInterrupt(f"{settings.trials} in {folder.parent.name}")

    monkeypatch.setattr(gpu, "is_likely", lambda: guess)
    monkeypatch.setattr(gpu, "is_used", lambda: used)
    monkeypatch.setattr(policy_evaluation, "rollouts", scored)
    with pytest.raises(KeyboardInterrupt, match=f"^{trials} in mine-.*-{trials}x"):
        evaluate.main(["--policy", "mine.safetensors"])


def test_fewer_executed_commands_make_another_evaluation(file, monkeypatch):
    def scored(folder, who, *_):
        raise KeyboardInterrupt(f"{who.trained.policy.execute} in {folder.parent.name}")

    monkeypatch.setattr(policy_evaluation, "rollouts", scored)
    with pytest.raises(KeyboardInterrupt, match=r"^1 in mine-.*-execute1-seed0-2x1s"):
        score("--execute", "1")
    with mistakes.of("--execute", POLICY.horizon + 1):
        score("--execute", str(POLICY.horizon + 1))


def test_another_way_to_sample_is_another_evaluation(file, capsys):
    score("--out", "here")
    made = policy_file.load(file)
    policy_file.save(file, made._replace(policy=config.with_options(POLICY, ddim_steps=1)))
    with mistakes.of("--out", "here"):
        score("--out", "here")
    (file.parent / "here" / "result.json").unlink()
    score("--out", "here")
    assert "chunks of another evaluation are replaced" in capsys.readouterr().out


def test_options_of_the_learner_make_another_evaluation(file):
    for _ in range(2):
        score("--sampling", "temperature=0.25", "ddim_steps=2", "--out", "here")
    changed = json.loads((file.parent / "here" / "result.json").read_text())
    made = policy_file.load(file)
    policy_file.save(file, made._replace(policy=config.with_options(POLICY, temperature=0.25)))
    assert changed["config"]["policy"]["temperature"] == 0.25
    assert changed["config"]["policy"]["ddim_steps"] == 2
    score("--sampling", "ddim_steps=2")
    (folder,) = (file.parent / "runs" / "evaluate").glob("mine-*-ddim_steps2-seed0-2x1s")
    assert json.loads((folder / "result.json").read_text())["seen"] == changed["seen"]


@pytest.mark.parametrize(
    ("words", "argument", "got"),
    [
        (["temperature"], "--sampling", "temperature"),
        (["temperature=warm"], "--sampling", "temperature=warm"),
        (["temperature=0.1", "temperature=0.2"], "--sampling", "temperature=0.2"),
        (["temperatur=0.1"], "option", "temperatur"),
        (["temperature=2"], "temperature", "2"),
    ],
)
def test_a_wrong_option_of_the_learner_is_one_line(file, words, argument, got):
    with mistakes.of(argument, got):
        score("--sampling", *words)


@pytest.mark.parametrize("damaged", ["{", "[]"])
def test_a_damaged_result_is_put_together_again(file, damaged):
    score("--out", "here")
    result = file.parent / "here" / "result.json"
    made = json.loads(result.read_text())
    result.write_text(damaged)
    score("--out", "here")
    assert json.loads(result.read_text())["trials"] == made["trials"]


def test_the_folder_of_a_run_is_no_place_for_a_result(file):
    for number, held in enumerate(("config.json", "demos-abc", "stardiff/config.json")):
        place = file.parent / f"here{number}" / held
        place.parent.mkdir(parents=True)
        place.write_text("{}")
        with mistakes.of("--out", f"here{number}"):
            score("--out", f"here{number}")


def test_results_of_two_at_once_are_not_mixed(file):
    (file.parent / "here").mkdir()
    with files.lock(file.parent / "here"), pytest.raises(files.StorageError, match="is in use by"):
        score("--out", "here")


def test_a_video_of_other_trials_does_not_stay(file):
    score("--out", "here", "--no-video")
    film = file.parent / "here" / "rollout.mp4"
    film.write_bytes(b"film")
    score("--out", "here", "--no-video")
    assert film.exists()
    score("--out", "here", "--no-video", "--seed", "3")
    assert not film.exists()
    film.write_bytes(b"film")
    score("--out", "here", "--seed", "4", "--eval.video-trials", "0")  # nothing to film
    assert not film.exists()


def test_plans_are_averaged_if_asked_for(file):
    assert score("--eval.ensemble") == 0
    (folder,) = (file.parent / "runs" / "evaluate").glob("*-ensemble")
    plan = json.loads((folder / "evaluation" / "plan.json").read_text())
    assert plan["agent"] == {"obs_horizon": 2, "execute": 1, "ensemble": 0.01}
    assert json.loads((folder / "result.json").read_text())["config"]["eval"]["ensemble"]


def test_the_seed_is_that_of_the_flag(file):
    score("--seed", "5", "--out", "here")
    plan = json.loads((file.parent / "here" / "evaluation" / "plan.json").read_text())
    assert plan["seed"] == 5 and plan["max_steps"] == 30
    result = json.loads((file.parent / "here" / "result.json").read_text())
    assert {trial["seed"] for trial in result["trials"]} == {5} == {result["seed"]}
    assert result["config"]["seed"] is None  # seed of the training, which no file of weights says


@pytest.mark.parametrize(("name", "label"), [("dp_ee", "DP-EE"), ("dp_ee_proj", "DP-EE-Proj")])
@pytest.mark.parametrize("typed", ["all", "dp_ee_proj"])
def test_a_method_of_a_run_of_several_is_scored_under_its_own_name(
    file, capsys, name, label, typed
):
    run = file.parent / "run"
    settings = dataclasses.replace(presets.PRESETS["smoke"], method=typed, seed=3)
    for folder in ("dp_ee", "dp_ee_proj"):
        folders.claim(run / folder, settings, "demos-a")
    file.rename(run / "dp_ee" / "policy.safetensors")
    flags = ["--seed", "7", "--eval.trials", "1", "--eval.time-limit-s", "1"]
    assert evaluate.main([f"run/{name}", *flags]) == 0
    said = capsys.readouterr().out
    assert f": {label} of run/{name}\n" in said and "1 s each, seed 7" in said
    result = json.loads((run / name / "evaluate-seed7-1x1s" / "result.json").read_text())
    assert (result["method"], result["config"]["method"]) == (name, name)
    assert (result["seed"], result["config"]["seed"]) == (7, 3)
    # settings of its training, not those next to the weights
    assert (result["config"]["train"]["steps"], result["seen"]["trials"]) == (77, 4)


def test_trials_are_run_as_the_policy_and_the_flags_say(tmp_path, monkeypatch):
    said = {}
    monkeypatch.setattr(
        policy_evaluation.evaluate, "evaluate", lambda *args, **given: said.update(given, args=args)
    )
    policy = dataclasses.replace(POLICY, obs_horizon=3, crop_fraction=0.5)
    trained = fakes.trained(method="stardiff", policy=policy, params=None, normalizer=None)
    policy = Policy(unused, unused, unused, unused)
    who = in_env.PolicyInEnv(trained, policy, stubs.make_env(), "")
    flags = {"trials": 5, "time_limit_s": 7.0, "chunk": 2, "video_trials": 3}
    policy_evaluation.rollouts(tmp_path, who, None, config.EvalConfig(**flags), 9)
    _, _, planner, _, _, settings = said["args"]
    assert settings._asdict() == {**flags, "seed": 9}
    assert planner.about == {"obs_horizon": 3, "execute": 4}
    assert said["identity"]["policy"]["crop_fraction"] == 0.5  # side of the encoder's image


def test_a_machine_without_a_video_encoder_still_gets_the_result(file, monkeypatch, capsys):
    def broken(runs, path):
        raise RuntimeError("no ffmpeg")

    monkeypatch.setattr(video, "record", broken)
    assert score() == 0
    assert "no video: no ffmpeg" in capsys.readouterr().out


def test_a_policy_called_policy_is_known_by_its_folder(tmp_path):
    """And by its content: most runs' folders have the names of their methods."""
    names = []
    for content in (b"a", b"b", b"a"):
        path = tmp_path / "stardiff" / "policy.safetensors"
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(content)
        names.append(policy_args.label(path))
    assert names[0] == names[2] != names[1] and all(n.startswith("stardiff-") for n in names)
    other = tmp_path / "compact.safetensors"
    other.write_bytes(b"c")
    assert policy_args.label(other).startswith("compact-")
    assert policy_args.label(packaged.folders()[-1] / "compact.safetensors") == "compact"


def test_sweeps_of_one_run_keep_their_trials_apart(file, capsys):
    run = file.parent / "dp_rcm2"
    run.mkdir()
    folders.claim(run, presets.PRESETS["smoke"], "demos-a")
    file.rename(run / "policy.safetensors")

    def swept(*flags):
        assert sweep.main([str(run), "--eval.time-limit-s", "1", *flags]) == 0
        return json.loads((run / "sweep.json").read_text())

    drawn, grid = ["--trocars", "5"], ["--radii-cm", "0", "2", "--azimuths", "3"]
    first = swept(*drawn)
    assert first["time_limit_s"] == 1.0 and len(first["weights"]) == 64
    chunks = {path: path.stat().st_mtime_ns for path in (run / "sweep").rglob("chunk*")}
    assert first["strict"]["trials"] == len(first["trials"]) == 5 and chunks
    assert {trial["trial"] for trial in first["trials"]} == {0}
    assert swept(*drawn, "--seed", "1")["trials"] != first["trials"]
    radii = [trial["radius"] for trial in swept(*grid)["trials"]]
    assert radii == [pytest.approx([radius]) for radius in (0, 0.02, 0.02, 0.02)]
    assert swept(*drawn, "--eval.chunk", "2")["trials"] == first["trials"]
    assert all(path.stat().st_mtime_ns == then for path, then in chunks.items())
    said = capsys.readouterr().out
    assert "replaced" not in said and "/1 = " in said.replace("  ", " ")


def test_a_sweep_has_the_time_limit_of_its_run(file):
    run = file.parent / "dp_rcm2"
    run.mkdir()
    settings = presets.PRESETS["smoke"]
    short = dataclasses.replace(settings.eval, time_limit_s=2.0)
    folders.claim(run, dataclasses.replace(settings, eval=short), "demos-a")
    file.rename(run / "policy.safetensors")
    assert sweep.main([str(run), "--trocars", "1"]) == 0
    found = json.loads((run / "sweep.json").read_text())
    assert found["time_limit_s"] == 2.0 and found["strict"]["trials"] == 1
    (run / "result.json").write_text('{"config": {"eval": {"time_limit_s": 1.0}}}')
    assert sweep.main([str(run), "--trocars", "1"]) == 0
    assert json.loads((run / "sweep.json").read_text())["time_limit_s"] == 1.0


@pytest.mark.parametrize(
    ("argv", "argument", "got"),
    [
        ([], "RUN or --policy", "none"),
        (["runs/x", "--policy", "y"], "RUN or --policy", "both"),
        (["nowhere"], "RUN", "nowhere"),
    ],
)
def test_a_mistake_names_what_was_wrong(argv, argument, got):
    with mistakes.of(argument, got):
        evaluate.main(argv)


def test_a_file_that_is_no_policy_leaves_nothing(file):
    run = file.parent / "dp_rcm2"
    run.mkdir()
    folders.claim(run, presets.PRESETS["smoke"], "demos-a")
    safetensors.numpy.save_file({"w": np.ones(2, np.float32)}, "other.safetensors")
    (file.parent / "words.safetensors").write_text("words")
    (file.parent / "damaged.safetensors").write_bytes(file.read_bytes()[:-3] + b"abc")
    before = sorted(file.parent.rglob("*"))
    for argument, given in (
        ("--policy", "--policy nowhere.safetensors"),
        ("--policy", "--policy words.safetensors"),
        ("--policy", "--policy damaged.safetensors"),
        ("--policy", "--policy other.safetensors"),
        ("--policy", "--policy other.safetensors --out here"),
        (str(run / "policy.safetensors"), "dp_rcm2"),
    ):
        with mistakes.of(argument):
            evaluate.main(given.split())
    assert sorted(file.parent.rglob("*")) == before


def test_distances_of_a_sweep_are_to_the_trocars_of_the_weights(file):
    run = file.parent / "dp_rcm2"
    run.mkdir()
    folders.claim(run, presets.PRESETS["smoke"], "demos-a")  # 8 trocars; the weights saw 4
    file.rename(run / "policy.safetensors")
    assert sweep.main([str(run), "--trocars", "9", "--eval.time-limit-s", "1"]) == 0
    trials = json.loads((run / "sweep.json").read_text())["trials"]
    ports = rcm.Trocar(*(np.float32([t[name] for t in trials]) for name in rcm.Trocar._fields))
    training = rcm.Trocar(*(field[:4, None] for field in rcm.TROCARS))
    far = sweeping.distance_to_nearest(ports, training, np.zeros((1, 3)))
    assert [t["distance_m"] for t in trials] == pytest.approx(far, abs=1e-6)


def test_another_arm_is_another_evaluation(file, monkeypatch):
    asked, made = [], in_env.sim_env.make
    monkeypatch.setattr(
        in_env.sim_env, "make", lambda *a, **k: asked.append(tuple(a[1])) or made(*a, **k)
    )
    assert score() == 0 and score("--arm", "ur5e") == 0
    assert asked == [("fr5",), ("ur5e",)]
    folders = {path.name for path in (file.parent / "runs" / "evaluate").iterdir()}
    assert len(folders) == 2 and len([name for name in folders if "-ur5e-seed0" in name]) == 1
    swept = ["--policy", str(file), "--trocars", "2", "--eval.time-limit-s", "1"]
    assert sweep.main(swept) == sweep.main([*swept, "--arm", "ur5e"]) == 0
    assert asked[2:] == [("fr5",), ("ur5e",)]
    found = [path.parent.name for path in file.parent.rglob("sweep.json")]
    assert len(set(found)) == 2 and len([name for name in found if name.endswith("-ur5e")]) == 1


def stressed(*more):
    trials = ["--eval.trials", "1", "--eval.time-limit-s", "1"]
    return stress.main(["--policy", "mine.safetensors", *trials, *more])


def test_a_policy_is_scored_at_every_level(file, capsys):
    assert stressed("--disturbance", "trocar_offset", "--levels", "0", "5") == 0
    (result,) = file.parent.rglob("stress.json")
    found = json.loads(result.read_text())
    levels = found["disturbances"]["trocar_offset"]["levels"]
    assert list(levels) == ["0", "5"] and found["method"] == "dp_rcm2"
    assert all(level["strict"]["trials"] == 12 for level in levels.values())
    force = [level["wall_force_N"] for level in levels.values()]
    assert all(0 < level["mean"] <= level["p99"] <= level["max"] for level in force)
    for level in levels.values():
        assert len(level["failed"]) == 12 - level["strict"]["successes"]
    names = {path.name for path in result.parent.iterdir()}
    assert {"index.html", "stress.md", "stress.png", "stress.pdf"} < names
    shown = html.unescape((result.parent / "index.html").read_text())
    assert shown.count("starjax view --trials") == 2
    for trials in ("0", "trocar_offset-5"):
        assert f"{trials}/recorded.npz" in shown
        assert (result.parent / trials / "recorded.npz").is_file()
    chunks = {path: path.stat().st_mtime_ns for path in result.parent.rglob("chunk*")}
    assert stressed("--disturbance", "trocar_offset", "--levels", "0", "5") == 0 and chunks
    assert all(path.stat().st_mtime_ns == then for path, then in chunks.items())
    assert capsys.readouterr().out.count("/12 = ") == 4


def test_a_policy_of_states_meets_no_disturbance_of_images(file):
    with mistakes.of("disturbance", "smoke"):
        stressed("--disturbance", "smoke")
    with mistakes.of("levels", 5.0):
        stressed("--disturbance", "observation_delay", "--levels", "0", "5")


def test_disturbances_at_once_have_a_row_of_their_own(file):
    names = ["trocar_offset", "breathing"]
    at_once = ["--together", "trocar_offset=5", "breathing=2"]
    assert stressed("--disturbance", *names, *at_once, "--out=both") == 0
    found = json.loads((file.parent / "both" / "stress.json").read_text())
    alone = found["disturbances"]["trocar_offset"]["levels"]["5"]
    both = found["together"]
    assert both["levels"] == {"trocar_offset": 5.0, "breathing": 2.0}
    assert both["strict"]["trials"] == 12 and both["rcm_error_mm"] != alone["rcm_error_mm"]
    with mistakes.of("together", "mass"):
        stressed("--disturbance", "trocar_offset", "--together", "mass=0.25", "--out=other")


def test_a_disturbance_may_name_its_levels(file):
    chosen = ["trocar_offset=5", "trocar_offset=1", "breathing=2"]
    assert stressed("--disturbance", *chosen, "--out=levels") == 0
    found = json.loads((file.parent / "levels" / "stress.json").read_text())["disturbances"]
    levels = {name: list(kind["levels"]) for name, kind in found.items()}
    assert levels == {"trocar_offset": ["0", "5", "1"], "breathing": ["0", "2"]}
    with mistakes.of("levels", "trocar_offset=5"):
        stressed("--disturbance", "trocar_offset=5", "--levels", "2")
    with mistakes.of("disturbance", "trocar_offset=fast"):
        stressed("--disturbance", "trocar_offset=fast")
    with mistakes.of("disturbance", 5.0):
        stressed("--disturbance", "observation_delay=5")
