"""The command line: presets, overrides, and mistakes that become one line."""

import dataclasses
import subprocess
import sys

import pytest

from starjax import cli, config
from starjax.experiments import checks, methods, options, presets, run


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
    ],
)
def test_a_mistake_is_one_line(argv, words):
    with pytest.raises(config.UsageError) as caught:
        settings(*argv)
    message = str(caught.value)
    assert "\n" not in message
    assert all(word in message for word in words), message


def test_mistakes_come_before_jax():
    program = (
        "import sys\n"
        "from starjax import cli\n"
        "sys.argv = ['starjax', 'run', '--train.stepps', '3']\n"
        "code = cli.main()\n"
        "print(code, {'jax', 'mujoco', 'numpy'} & set(sys.modules))\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout.strip() == "2 set()"
    assert len(done.stderr.strip().splitlines()) == 1 and "Traceback" not in done.stderr


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
    monkeypatch.setenv("JAX_PLATFORMS", "cuda,cpu")
    assert presets.has_gpu()


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
    import json

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
        (PermissionError(13, "Permission denied", "runs/y"), 74, "runs/y"),
    ],
)
def test_guard_turns_what_a_user_can_mend_into_one_line(error, code, word, capsys):
    def command(argv):
        raise error

    assert cli.guard(command, []) == code
    said = capsys.readouterr().err
    assert word in said and len(said.strip().splitlines()) == 1


def test_guard_lets_a_fault_of_the_program_through():
    def command(argv):
        raise ValueError("a bug")

    with pytest.raises(ValueError, match="a bug"):
        cli.guard(command, [])
