"""The command line: presets, overrides, and mistakes that become one line."""

import dataclasses
import json
import os
import re
import subprocess
import sys
import types

import numpy as np
import pytest
import stubs

from starjax import cli, config, methods
from starjax.experiments import (
    bench,
    checks,
    demonstrations,
    evaluate,
    folders,
    options,
    pack,
    presets,
    report_command,
    run,
    sweep,
)
from starjax.runtime import files, xla

SMOKE = presets.PRESETS["smoke"]


def settings(*argv: str) -> config.RunConfig:
    return run.settings(argv, "starjax run", "")


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["--trian.steps", "3"], ["--trian.steps", "did you mean --train.steps"]),
        (["--train.steps", "x"], ["--train.steps", "whole number", "'x'"]),
        (["--train.steps"], ["--train.steps", "1 value", "none"]),
        (["--train.steps", "3", "4"], ["--train.steps", "1 value", "3 4"]),
        (["--train.learning-rate", "fast"], ["--train.learning-rate", "a number", "'fast'"]),
        (["--policy.observation", "imag"], ["--policy.observation", "image, state", "mean image"]),
        (["--method", "stardif"], ["--method", "dp_rcm4", "did you mean stardiff"]),
        (["--preset", "cpi"], ["--preset", "smoke", "did you mean cpu"]),
        (["--policy.execute", "17"], ["--policy.execute", "16", "17"]),
        (["--policy.obs-horizon", "10"], ["--policy.obs-horizon", "policy.execute + 1 = 9", "10"]),
        (["--policy.unet-channels", "64", "100"], ["--policy.unet-channels", "8", "100"]),
        (["--train.steps", "0"], ["--train.steps", "more than 0", "0"]),
        (["--demos.seen-trocars=9"], ["--demos.seen-trocars", "1 to 8", "9"]),
        (["--demos.keep-failures", "yes"], ["--demos.keep-failures", "0 value", "yes"]),
        (["--policy.freeze-encoder", "yes"], ["--policy.freeze-encoder", "0 value", "yes"]),
        (
            ["--preset=smoke", "--policy.freeze-encoder"],
            ["--policy.freeze-encoder", "--policy.observation image"],
        ),
        (
            ["--preset=smoke", "--policy.freeze-encoder", "--policy.observation", "image"],
            ["--policy.freeze-encoder", "--policy.encoder-weights", "got none"],
        ),
        (["stardiff"], ["stardiff", "flag"]),
        (["--seed", "-1"], ["--seed", "0 to 4294967295", "-1"]),
        (["--seed", "4294967296"], ["--seed", "0 to 4294967295", "4294967296"]),
        (["--train.learning-rate", "nan"], ["--train.learning-rate", "a finite number", "nan"]),
        (["--train.weight-decay", "inf"], ["--train.weight-decay", "a finite number", "inf"]),
        (["--eval.time-limit-s", "inf"], ["--eval.time-limit-s", "a finite number", "inf"]),
        (["--eval.time-limit-s", "0"], ["--eval.time-limit-s", "0.1 to 86400 s", "got 0"]),
        (["--eval.time-limit-s", "86401"], ["--eval.time-limit-s", "0.1 to 86400 s", "86401"]),
        (["--eval.trials", "0"], ["--eval.trials", "1 to 1000000", "got 0"]),
        (["--eval.trials", "1000001"], ["--eval.trials", "1 to 1000000", "1000001"]),
        (["--out="], ["--out", "a folder"]),
        (["--out", ""], ["--out", "a folder"]),
        (["--policy.ddim-steps", "1"], ["--policy.ddim-steps", "2 to", "= 100", "got 1"]),
        (["--policy.time-dim", "2"], ["--policy.time-dim", "even", "4 or more", "got 2"]),
        (["--policy.time-dim", "65"], ["--policy.time-dim", "even", "4 or more", "got 65"]),
        (["--policy.kernel-size", "4"], ["--policy.kernel-size", "an odd number", "got 4"]),
        (["--policy.kernel-size", "-1"], ["--policy.kernel-size", "above 0", "got -1"]),
        (["--policy.vision-dim", "1"], ["--policy.vision-dim", "2 or more", "got 1"]),
        (["--policy.state-dim", "3"], ["--policy.state-dim", "4 or more", "got 3"]),
        (["--policy.roll-blocks", "-1"], ["--policy.roll-blocks", "0 or more", "-1"]),
        (["--policy.roll-loss-weight", "-1"], ["--policy.roll-loss-weight", "0 or more", "-1"]),
        (["--train.roll-weight-decay", "-1"], ["--train.roll-weight-decay", "0 or more", "-1"]),
        (["--train.warmup-steps", "-1"], ["--train.warmup-steps", "0 or more", "-1"]),
        (["--train.weight-decay", "-1"], ["--train.weight-decay", "0 or more", "-1"]),
        (["--train.state-noise", "-1"], ["--train.state-noise", "0 or more", "-1"]),
        (["--train.image-noise", "-1"], ["--train.image-noise", "0 or more", "-1"]),
        (["--train.jitter", "-1"], ["--train.jitter", "0 or more", "-1"]),
        (
            ["--preset=paper", "--policy.image-size", "34"],
            ["--policy.image-size", "more than 32 pixels", "policy.crop-fraction = 0.9", "got 31"],
        ),
        (
            ["--preset=smoke", "--policy.encoder-weights", "compact"],
            ["--policy.encoder-weights", "--policy.observation image", "got state"],
        ),
        (
            ["--policy.diffusion-steps", "1"],
            ["--policy.diffusion-steps", "2 or more", "got 1"],
        ),
        (
            ["--preset=smoke", "--policy.freeze_encoder"],
            ["--policy.freeze-encoder", "--policy.observation image"],
        ),
        (["--preset", "smoke", "--preset", "cpi"], ["--preset", "did you mean cpu"]),
    ],
)
def test_a_mistake_is_one_line(argv, words):
    with pytest.raises(config.UsageError) as caught:
        settings(*argv)
    message = str(caught.value)
    assert "\n" not in message
    assert all(word in message for word in words), message


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--eval.trials", "0"], ["--eval.trials", "1 to 1000000", "got 0"]),
        (["--eval.time-limit-s", "0"], ["--eval.time-limit-s", "0.1 to 86400 s", "got 0"]),
        (["--seed", "-1"], ["--seed", "0 to 4294967295", "-1"]),
        (["--trocars", "0"], ["--trocars", "1 to 1000000", "got 0"]),
        (["--radii-cm", "2", "--azimuths", "0"], ["--azimuths", "1 to 1000000", "got 0"]),
        (["--radii-cm", "2", "--azimuths", "-3"], ["--azimuths", "1 to 1000000", "-3"]),
        (
            ["--radii-cm", "2", "3", "--azimuths", "600000"],
            ["--azimuths", "at most 1000000 ports of its grid", "1200000"],
        ),
        (["--radii-cm", "2", "nan"], ["--radii-cm", "a finite number", "nan"]),
        (["--azimuths", "6"], ["--azimuths", "--radii-cm beside it", "6"]),
        (["--polars-deg", "80"], ["--polars-deg", "--radii-cm beside it", "80"]),
        (["--radii-cm", "2", "--trocars", "9"], ["--trocars", "nothing with --radii-cm", "9"]),
        (["--radii-cm", "2", "-1"], ["--radii-cm", "0 to 10 cm", "-1"]),
        (["--polars-deg", "181"], ["--polars-deg", "0 to 180 degrees", "181"]),
        ([], ["no/stardiff", "no config.json"]),
    ],
)
def test_sweep_names_the_flag(flags, words):
    with pytest.raises(config.UsageError) as caught:
        sweep.main(["no/stardiff", *flags])
    assert all(word in str(caught.value) for word in words), str(caught.value)


@pytest.mark.parametrize("calls", ["0", "-1"])
def test_bench_times_one_call_at_least(calls):
    with pytest.raises(config.UsageError, match=f"^--calls: expected 1 or more, got {calls}$"):
        bench.main(["no/stardiff", "--calls", calls])


@pytest.mark.parametrize("command", [sweep, bench])
def test_a_renamed_folder_is_explained(command, tmp_path):
    with pytest.raises(config.UsageError, match="RUN: expected a method's folder"):
        command.main([str(tmp_path / "policy2")])


@pytest.fixture
def scored(tmp_path):
    """A method's folder as far as bench asks for it."""
    folder = tmp_path / "stardiff"
    folder.mkdir()
    folders.claim(folder, SMOKE, "demos-a")
    (folder / "result.json").write_text('{"method": "stardiff"}')
    return folder


def test_bench_writes_beside_the_result_of_the_folder_it_is_in(scored, monkeypatch, capsys):
    timed = {"weights": "a"}
    monkeypatch.setattr(bench, "_time", lambda folder, *_: {**timed, "timed": folder.name})
    monkeypatch.chdir(scored)
    assert bench.main(["."]) == 0
    assert capsys.readouterr().out.endswith(f"starjax report {scored} shows it\n")
    found = json.loads((scored / "bench.json").read_text())
    assert (found["method"], found["timed"]) == ("stardiff", "stardiff")
    assert found["hardware"]["cores"] >= 1 and found["versions"]["starjax"]
    assert json.loads((scored / "result.json").read_text()) == {"method": "stardiff"}
    (scored / "result.json").write_text('{"method": "stardiff", "weights": "b"}')
    assert bench.main(["."]) == 0
    assert "shows it once starjax run has scored these weights" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("flags", "counts"), [([], (1, 2, 5, 10, 20, 50)), (["--ddim-steps", "3", "60"], (3, 60))]
)
def test_bench_times_what_table_iv_has_and_the_policy_can(scored, monkeypatch, flags, counts):
    few = dataclasses.replace(SMOKE.policy, diffusion_steps=60)
    folders.claim(scored, dataclasses.replace(SMOKE, policy=few), "demos-a")
    timed = []
    monkeypatch.setattr(bench, "_time", lambda *given: timed.append(given) or {"weights": "a"})
    assert bench.main([str(scored), *flags]) == 0
    assert timed == [(scored, counts, 100)]
    with pytest.raises(config.UsageError, match=r"^--ddim-steps: expected 1 to 60, got 61$"):
        bench.main([str(scored), "--ddim-steps", "61"])


def test_bench_promises_nothing_after_ctrl_c(scored, monkeypatch, capsys):
    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(bench, "_time", stop)
    assert cli.guard(bench.main, [str(scored)]) == 130
    said = capsys.readouterr().err
    assert "bench saves its figures only at its end" in said and "same command" not in said
    assert not (scored / "bench.json").exists()


def test_too_few_steps_for_the_expert_name_the_flag(tmp_path, monkeypatch):
    from starjax.data import demos
    from starjax.rollouts import chunks

    def collect(*_, **settings):
        raise chunks.ExpertFailed("got 0 of 10 at trocar 0")

    monkeypatch.setattr(demos, "collect", collect)
    few = dataclasses.replace(SMOKE.demos, max_steps=1)
    tried = dataclasses.replace(SMOKE, demos=few, out=str(tmp_path))
    _, missing = demonstrations.plan(tried, stubs.make_env())
    with pytest.raises(config.UsageError, match=r"^--demos.max-steps: .*, got 1; .*0 of 10"):
        missing()


@pytest.mark.parametrize(
    ("argv", "heavy"),
    [
        (["run", "--train.stepps", "3"], {"jax", "mujoco", "numpy"}),
        (["run", "--seed", "-1"], {"jax", "mujoco", "numpy"}),
        (["sweep", "x", "--trocars", "0"], {"jax", "mujoco"}),
    ],
)
def test_mistakes_come_before_jax(argv, heavy):
    program = (
        "import sys\n"
        "from starjax import cli\n"
        "code = cli.guard(cli.dispatch, sys.argv[1:])\n"
        f"print(code, {heavy} & set(sys.modules))\n"
    )
    done = subprocess.run([sys.executable, "-c", program, *argv], capture_output=True, text=True)
    assert done.stdout.strip() == "2 set()", done.stdout
    assert len(done.stderr.strip().splitlines()) == 1 and "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("argv", "value"),
    [
        ([], None),
        (["--preset", "smoke", "--preset", "paper"], "paper"),
        (["--preset=smoke", "--preset", "paper", "--seed", "1"], "paper"),
        (["--preset", "smoke", "--preset=paper"], "paper"),
        (["--preset", "smoke", "--preset"], "smoke"),
    ],
)
def test_the_last_of_a_flag_wins(argv, value):
    assert options.value_of("--preset", argv) == value


def test_a_flag_is_found_however_it_is_spelled():
    assert options.value_of("--eval.time-limit-s", ["--eval.time_limit-s=3"]) == "3"
    assert options.value_of("--out", ["--out", "a_b"]) == "a_b"
    assert options.is_given("--policy.freeze-encoder", ["--policy.freeze_encoder"])
    assert not options.is_given("--policy.freeze-encoder", ["--policy.no-freeze-encoder"])
    assert settings("--preset", "smoke", "--preset", "paper").preset == "paper"


def test_flags_override_the_preset_and_nothing_else():
    changed = settings("--preset=smoke", "--train.steps", "7", "--policy.unet-channels", "32")
    expected = dataclasses.replace(
        presets.PRESETS["smoke"],
        train=dataclasses.replace(presets.PRESETS["smoke"].train, steps=7),
        policy=dataclasses.replace(presets.PRESETS["smoke"].policy, unet_channels=(32,)),
    )
    assert changed == expected


def test_other_observations_and_seeds_have_folders_of_their_own():
    assert settings("--preset", "cpu").out == "runs/cpu"
    assert settings("--preset", "cpu", "--seed=3").out == "runs/cpu-seed3"
    typed = ["--preset", "cpu", "--policy.observation", "state", "--seed", "3"]
    assert settings(*typed).out == "runs/cpu-state-seed3"
    assert settings(*typed, "--out", "runs/cpu").out == "runs/cpu"


def test_a_frozen_encoder_has_a_folder_of_its_own():
    typed = ["--policy.observation", "image", "--policy.freeze-encoder"]
    typed += ["--policy.encoder-weights", "x"]
    assert settings("--preset", "smoke", *typed).out == "runs/smoke-image-frozen"
    assert settings("--preset", "cpu", "--policy.no-freeze-encoder").out == "runs/cpu-unfrozen"


def test_a_presets_encoder_is_no_part_of_a_run_that_sees_the_state():
    policy = settings("--preset", "cpu", "--policy.observation", "state").policy
    assert presets.PRESETS["cpu"].policy.freeze_encoder
    assert not policy.freeze_encoder and not policy.encoder_weights
    with pytest.raises(config.UsageError, match="freeze-encoder: expected"):
        settings("--preset", "cpu", "--policy.observation", "state", "--policy.freeze-encoder")


def test_auto_is_named_by_what_it_picked(monkeypatch):
    monkeypatch.setattr(presets, "has_gpu", lambda: False)
    assert settings().preset == settings("--preset", "auto").preset == "cpu"
    monkeypatch.setattr(presets, "has_gpu", lambda: True)
    assert settings().preset == "gpu"


def test_jax_platforms_forbids_the_gpu(monkeypatch):
    monkeypatch.setattr(presets, "has_gpu_device", lambda: True)
    monkeypatch.setattr(presets, "has_gpu_plugin", lambda: True)
    monkeypatch.setenv("JAX_PLATFORMS", "cpu")
    assert not presets.has_gpu()
    monkeypatch.setenv("JAX_PLATFORMS", "cpu,cuda")  # jax takes the first
    assert not presets.has_gpu()
    monkeypatch.setenv("JAX_PLATFORMS", "cuda,cpu")
    assert presets.has_gpu()


@pytest.mark.parametrize(("visible", "seen"), [("", False), ("-1", False), ("1", True)])
def test_a_gpu_may_be_hidden(monkeypatch, visible, seen):
    monkeypatch.setattr(presets, "has_gpu_device", lambda: True)
    monkeypatch.setattr(presets, "has_gpu_plugin", lambda: True)
    monkeypatch.delenv("JAX_PLATFORMS", raising=False)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    assert presets.has_gpu() == seen


@pytest.mark.parametrize(("device", "plugin"), [(True, False), (False, True)])
def test_a_gpu_is_a_device_with_its_plugin(monkeypatch, device, plugin):
    monkeypatch.setattr(presets, "has_gpu_device", lambda: device)
    monkeypatch.setattr(presets, "has_gpu_plugin", lambda: plugin)
    for name in ("JAX_PLATFORMS", "CUDA_VISIBLE_DEVICES"):
        monkeypatch.delenv(name, raising=False)
    assert not presets.has_gpu()


def test_a_grid_is_in_centimetres_and_degrees():
    grid = {"radii_cm": (2.0, 5.0), "polars_deg": (70.0,), "azimuths": 4}
    found = sweep._trocars(sweep.Options(run="x", **grid))
    np.testing.assert_allclose(np.unique(found.radius), [0.02, 0.05], rtol=1e-6)
    np.testing.assert_allclose(np.rad2deg(found.polar), 70, rtol=1e-6)
    np.testing.assert_allclose(np.rad2deg(found.azimuth[:4]), [0, 90, 180, 270], atol=1e-4)


@pytest.mark.parametrize("name", presets.PRESETS)
@pytest.mark.parametrize("method", [*methods.METHODS, "all"])
def test_presets_pass_their_own_checks(name, method):
    preset = presets.PRESETS[name]
    assert preset.preset == name
    checks.check(dataclasses.replace(preset, method=method))


def test_paper_preset_is_the_default_configuration():
    paper = presets.PRESETS["paper"]
    assert dataclasses.replace(paper, preset="auto", out="runs") == config.RunConfig()
    assert (paper.train.steps, paper.train.batch_size) == (100_000, 256)


@pytest.mark.parametrize("name", presets.PRESETS)
def test_configuration_survives_json(name):
    values = json.loads(json.dumps(dataclasses.asdict(presets.PRESETS[name])))
    assert config.from_dict(config.RunConfig, values) == presets.PRESETS[name]
    with pytest.raises(ValueError, match="stepps"):
        config.from_dict(config.TrainConfig, {"stepps": 1})


def test_every_field_has_its_flag():
    flags = options.flags(config.RunConfig)
    assert {"--seed", "--train.steps", "--demos.no-keep-failures", "--eval.time-limit-s"} <= {
        *flags
    }
    parts = (config.DemosConfig, config.PolicyConfig, config.TrainConfig, config.EvalConfig)
    leaves = [field for part in parts for field in dataclasses.fields(part)]
    twins = sum(isinstance(field.default, bool) for field in leaves)  # a switch has a no- twin
    assert twins and len(flags) == len(leaves) + twins + 4  # method, preset, seed, out


@pytest.mark.parametrize(
    ("error", "code", "word"),
    [
        (config.UsageError("--seed: expected 0 or more, got -1"), 2, "--seed"),
        (KeyboardInterrupt(), 130, "same command"),
        (OSError(28, "No space left on device", "runs/x"), 74, "runs/x"),
        (OSError(28, "No space left on device", "runs/x"), 74, "cannot write:"),
        (PermissionError(13, "Permission denied", "runs/y"), 74, "cannot read or write: runs/y"),
        (OSError(36, "File name too long", "runs/y"), 74, "File name too long"),
        (MemoryError("Unable to allocate 9 GiB"), 71, "too little memory (Unable to allocate 9"),
        (files.StorageError("runs/z: the disk is full"), 74, "runs/z"),
    ],
)
def test_guard_turns_what_a_user_can_mend_into_one_line(error, code, word, capsys):
    def command(argv):
        raise error

    assert cli.guard(command, []) == code
    said = capsys.readouterr().err
    assert word in said and len(said.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("argv", "run", "trocars"),
    [
        (["x/stardiff", "--trocars", "3"], "x/stardiff", 3),
        (["--trocars", "3", "x/stardiff"], "x/stardiff", 3),
        (["--trocars=3", "x=y/stardiff", "--seed", "1"], "x=y/stardiff", 3),
    ],
)
def test_words_may_stand_anywhere(argv, run, trocars):
    found = sweep._parse(argv)
    assert (found.run, found.trocars) == (run, trocars)


@pytest.mark.parametrize(
    ("command", "argv", "said"),
    [
        ("evaluate", "x y", "RUN: expected 1, got x y"),
        ("evaluate", "--no-video x --seed 3 y", "RUN: expected 1, got x y"),
        ("sweep", "--radii-cm 1 2", "RUN: expected 1, got none"),
        ("report", "--out x", "RUN: expected one or more, got none"),
        ("pack", "a b c", "POLICY OUT: expected 2, got a b c"),
        ("run", "--seed 1 2", "--seed: expected 1 value(s), got 1 2"),
        ("run", "x", "x: expected a flag such as --method"),
        ("evaluate", "x --video=False", "--video: expected 0 value(s), got False"),
    ],
)
def test_too_few_and_too_many_words_are_one_line(command, argv, said, capsys):
    assert cli.guard(cli.dispatch, [command, *argv.split()]) == 2
    assert capsys.readouterr().err == f"starjax: {said}\n"


def test_guard_lets_a_fault_of_the_program_through():
    def command(argv):
        raise ValueError("a bug")

    with pytest.raises(ValueError, match="a bug"):
        cli.guard(command, [])


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ("bench", "RUN"),
        ("evaluate", "[RUN]"),
        ("pack", "POLICY OUT"),
        ("report", "RUN [RUN ...]"),
        ("sweep", "RUN"),
    ],
)
def test_help_names_the_words_before_the_flags(command, words, capsys):
    with pytest.raises(SystemExit):
        cli.dispatch([command, "--help"])
    usage, box = capsys.readouterr().out.split("positional arguments")
    assert words in usage.splitlines()[0]
    assert "STR" not in box.split("options")[0]


def helped(command, capsys):
    """What help says of each flag, without its default."""
    with pytest.raises(SystemExit):
        cli.dispatch([command, "--help"])
    found, entry = {}, []
    for line in capsys.readouterr().out.replace("│", " ").splitlines():
        if flag := re.match(r"  (--?\w[^ ,]*)", line):
            entry = found[flag[1]] = re.split(r"\s{2,}", line.strip(), maxsplit=1)[1:]
        elif line.startswith(" " * 6):
            entry.append(line.strip())
    said = {flag: " ".join(" ".join(entry).split()) for flag, entry in found.items()}
    return {flag: re.sub(r" ?\(default: .*\)$", "", text) for flag, text in said.items()}


@pytest.mark.parametrize(
    ("command", "settings"),
    [
        *((name, config.RunConfig) for name in ("run", "collect", "train")),
        ("evaluate", evaluate.Options),
        ("sweep", sweep.Options),
        ("bench", bench.Options),
        ("pack", pack.Options),
        ("report", report_command.Options),
    ],
)
def test_help_says_of_every_flag_something_of_its_own(command, settings, capsys):
    said = helped(command, capsys)
    flags = {flag for flag in options.flags(settings) if not re.search(r"--(\w+\.)?no-", flag)}
    assert {*said} == {*flags, "-h"}
    unsaid = {flag for flag, text in said.items() if not text}
    shared = {flag for flag, text in said.items() if [*said.values()].count(text) > 1}
    assert not unsaid and not shared


def shown(command, flag, capsys):
    """What help says of a flag, with its default, in one line."""
    with pytest.raises(SystemExit):
        cli.dispatch([command, "--help"])
    said = " ".join(capsys.readouterr().out.replace("│", " ").split())
    return said.split(f"{flag} ")[1].split(" --")[0]


def test_help_of_a_sweep_says_whose_time_limit_it_has(capsys):
    said = shown("sweep", "--eval.time-limit-s", capsys)
    assert said.endswith("; left out: RUN's") and "default" not in said


@pytest.mark.parametrize(("gpu", "trials", "limit"), [(False, 4, 30.0), (True, 30, 60.0)])
def test_help_of_an_evaluation_shows_what_it_does(gpu, trials, limit, monkeypatch, capsys):
    monkeypatch.setattr(presets, "has_gpu", lambda: gpu)
    assert f"(default: {trials})" in shown("evaluate", "--eval.trials", capsys)
    assert f"(default: {limit})" in shown("evaluate", "--eval.time-limit-s", capsys)
    with pytest.raises(SystemExit):
        cli.dispatch(["evaluate", "--help"])
    assert "not those of RUN" in " ".join(capsys.readouterr().out.split())


@pytest.mark.parametrize("command", ["evaluate", "sweep", "bench", "pack", "report"])
def test_help_shows_no_empty_default(command, capsys):
    with pytest.raises(SystemExit):
        cli.dispatch([command, "--help"])
    assert not re.search(r"\(default:\s*(''|None)?\)", capsys.readouterr().out)


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (["--train.ema-max", "1"], "--train.ema-max: expected in [0, 1), got 1.0"),
        (["--policy.crop-fraction", "1.1"], "--policy.crop-fraction: expected in (0, 1], got 1.1"),
        (["--train.holdout-demos", "-1"], "--train.holdout-demos: expected 0 or more, got -1"),
        (["--eval.chunk", "-1"], "--eval.chunk: expected 0 or more, got -1"),
        (["--eval.video-trials", "-1"], "--eval.video-trials: expected 0 or more, got -1"),
        (["--policy.temperature", "1.1"], "--policy.temperature: expected in [0, 1], got 1.1"),
        (["--policy.ddim-steps", "101"], "--policy.ddim-steps: expected 2 to policy.diff"),
        (["--policy.horizon", "10"], "--policy.horizon: expected a multiple of 4 for 3 U-Net"),
        (["--policy.image-size", "31"], "--policy.image-size: expected 32 pixels or more, got 31"),
        (["--preset=paper", "--policy.image-size", "36"], "--policy.image-size: expected more tha"),
        *(
            ([f"--{name}", "0"], f"--{name}: expected more than 0, got 0")
            for name in (
                "demos.per-trocar", "demos.max-steps", "policy.obs-horizon", "policy.execute",
                "policy.groups", "policy.roll-width", "train.batch-size", "train.learning-rate",
                "train.steps-per-call", "train.checkpoint-every", "train.keep-checkpoints",
                "train.log-every",
            )
        ),
    ],
)  # fmt: skip
def test_what_would_fail_later_is_a_mistake(argv, said):
    with pytest.raises(config.UsageError) as caught:
        settings("--preset=cpu", *argv)
    assert str(caught.value).startswith(said)


@pytest.fixture
def places(tmp_path, monkeypatch):
    """A folder with a file, one that may not be written, and what report and evaluate read."""
    (tmp_path / "file").touch()
    (tmp_path / "link").symlink_to("nowhere")
    (tmp_path / "closed").mkdir()
    (tmp_path / "result.json").write_text("{}")
    (tmp_path / "policy.safetensors").touch()
    is_open = os.access
    # Not by its mode, which does not bind the superuser.
    monkeypatch.setattr(
        os, "access", lambda place, mode: "closed" not in str(place) and is_open(place, mode)
    )
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    "command",
    [
        "run --preset smoke --out",
        "collect --preset smoke --out",
        "train --preset smoke --out",
        "evaluate --policy policy.safetensors --out",
        "report . --out",
    ],
)
@pytest.mark.parametrize(
    ("out", "said"),
    [
        ("file", "a folder, got file"),
        ("file/below/it", "a folder, got file/below/it; file is not one"),
        ("link", "a folder, got link"),
        ("closed", "a folder that may be written, got closed"),
        ("closed/below", "a folder that may be written, got closed/below; closed may not"),
        ("x" * 300, f"a folder, got {'x' * 300}: File name too long"),
    ],
)
def test_a_folder_that_cannot_be_used_is_a_mistake_of_its_flag(command, out, said, places, capsys):
    before = sorted(places.rglob("*"))
    assert cli.guard(cli.dispatch, [*command.split(), out]) == 2
    assert capsys.readouterr().err == f"starjax: --out: expected {said}\n"
    assert sorted(places.rglob("*")) == before


@pytest.mark.parametrize("out", ["file/mine.safetensors", "closed/mine.safetensors"])
def test_a_file_is_packed_into_a_folder(out, places, capsys):
    assert cli.guard(cli.dispatch, ["pack", "policy.safetensors", out]) == 2
    assert "starjax: folder of OUT: expected a folder" in capsys.readouterr().err


def test_a_report_that_cannot_be_made_leaves_nothing(places):
    before = sorted(places.rglob("*"))
    with pytest.raises(config.UsageError, match="method: expected text"):
        report_command.main([".", "--out", "new"])
    assert sorted(places.rglob("*")) == before


@pytest.mark.parametrize(
    ("command", "said"),
    [
        (["evaluate", "--policy", "compact", "--out="], "--out: expected a folder, got nothing"),
        (["report", ".", "--out", ""], "--out: expected a folder, got nothing"),
        (["report", ""], "RUN: expected a folder with a result.json, or of such, got none"),
        (["pack", "compact", ""], "OUT: expected a file that is not there yet, got none"),
    ],
)
def test_a_word_that_is_empty_is_a_mistake(command, said, places, monkeypatch, capsys):
    monkeypatch.setattr(xla, "prepare_xla", lambda: pytest.fail("it was about to begin"))
    assert cli.guard(cli.dispatch, command) == 2
    assert capsys.readouterr().err == f"starjax: {said}\n"


@pytest.mark.parametrize("command", ["pack policy.safetensors new", "report . --out new"])
def test_a_platform_that_jax_cannot_use_is_one_line(command, places, monkeypatch, capsys):
    import jax

    def refuse():
        raise RuntimeError("no such platform")

    monkeypatch.setattr(jax, "local_devices", refuse)
    assert cli.guard(cli.dispatch, command.split()) == 2
    said = capsys.readouterr().err
    assert said.startswith("starjax: JAX_PLATFORMS: ") and said.count("\n") == 1
    assert not (places / "new").exists()


COUNTS = [flag for flag, kind in options.flags(config.RunConfig).items() if kind is int]


@pytest.mark.parametrize("flag", [*COUNTS, "--policy.unet-channels"])
def test_a_slip_of_the_hand_is_a_mistake_of_its_flag(flag):
    huge = str(2**70 + 1 if flag == "--policy.kernel-size" else 2**70)
    with pytest.raises(config.UsageError) as caught:
        settings("--preset=smoke", flag, huge)
    assert str(caught.value).startswith(f"{flag}: expected ") and huge in str(caught.value)


@pytest.mark.parametrize(("method", "timed"), [("stardiff", True), ("dp_rcm4", False)])
def test_only_the_hierarchy_has_a_roll_network_to_time(
    monkeypatch, capsys, tmp_path, method, timed
):
    from starjax.evaluation import latency
    from starjax.experiments import scoring

    ms = {"p50": 4.0, "p95": 5.0, "p99": 8.0}
    trained = types.SimpleNamespace(policy=None, train=None, params=None, normalizer=None)
    env = types.SimpleNamespace(p_world_ref=None)
    who = types.SimpleNamespace(trained=trained, env=env, weights="a")
    monkeypatch.setattr(scoring, "subject", lambda *_: who)
    monkeypatch.setattr(latency, "table", lambda *_, **__: iter([{"ddim_steps": 2, **ms}]))
    monkeypatch.setattr(latency, "roll_ms", lambda *_, **__: ms)
    assert bool(bench._time(tmp_path / method, (2,), 1)["roll_network_ms"]) == timed
    assert capsys.readouterr().out.splitlines()[1].split() == [
        "2",
        "4.000",
        "5.000",
        "8.000",
        "250.0",
    ]


def test_sweeps_of_other_trials_lie_apart(tmp_path):
    one = sweep.Options("run")
    other = dataclasses.replace(one, eval=dataclasses.replace(one.eval, trials=2))
    same = dataclasses.replace(one, eval=dataclasses.replace(one.eval, chunk=2))
    assert sweep._folder(tmp_path, one) == sweep._folder(tmp_path, same)
    assert sweep._folder(tmp_path, one) != sweep._folder(tmp_path, other)


@pytest.mark.parametrize(("seen", "one_wall"), [(1, True), (8, False)])
def test_demonstrations_are_those_that_were_asked_for(tmp_path, monkeypatch, seen, one_wall):
    from starjax import rcm
    from starjax.data import demos
    from starjax.sim.tasks.peg_transfer import expert

    given = []
    found = {"episodes": 0, "trials": 0, "frames": 0}
    monkeypatch.setattr(
        demos, "collect", lambda *a, **settings: given.append((a, settings)) or found
    )
    asked = config.DemosConfig(per_trocar=3, seen_trocars=seen, max_steps=7, one_wall=one_wall)
    chosen = dataclasses.replace(SMOKE, demos=asked, seed=5, out=str(tmp_path))
    demonstrations.plan(chosen, stubs.make_env())[1]()
    (((_, _, script, trocars), settings),) = given
    np.testing.assert_array_equal(trocars, [field[:seen] for field in rcm.TROCARS])
    assert script.init is (expert.init_with_one_wall if one_wall else expert.init)
    wanted = {"per_trocar": 3, "seed": 5, "max_steps": 7, "one_wall": one_wall}
    assert {name: settings[name] for name in wanted} == wanted
