"""Command lines become settings, or a mistake that names its flag."""

import contextlib
import dataclasses
import re
import shlex
import subprocess
import sys

import mistakes
import pytest

from starjax import cli
from starjax.cli import (
    bench,
    completion,
    evaluate,
    options,
    pack,
    presets,
    report_command,
    run_settings,
    stress,
    sweep,
)
from starjax.core import config, extras, methods
from starjax.runtime import gpu

OPTIONS = {
    **dict.fromkeys(("run", "collect", "train"), config.RunConfig),
    "evaluate": evaluate.EvaluateArgs,
    "sweep": sweep.SweepArgs,
    "stress": stress.StressArgs,
    "bench": bench.BenchArgs,
    "pack": pack.PackArgs,
    "report": report_command.ReportArgs,
}


def settings(typed: str) -> config.RunConfig:
    return run_settings.parse("run", typed.split(), "")


@pytest.mark.parametrize(
    ("command", "typed", "argument", "got"),
    [
        ("run", "--trian.steps 3", "FLAG", "--trian.steps"),
        ("run", "--train.steps x", "--train.steps", "'x'"),
        ("run", "--train.steps 1e3", "--train.steps", "'1e3'"),
        ("run", "--train.steps", "--train.steps", "none"),
        ("run", "--train.steps 3 4", "FLAG", "4"),
        ("run", "--train.learning-rate fast", "--train.learning-rate", "'fast'"),
        ("run", "--policy.observation imag", "--policy.observation", "'imag'"),
        ("run", "--policy.unet-channels 8 x", "--policy.unet-channels", "'x'"),
        ("run", "--method stardif", "method", "'stardif'"),
        ("run", "--preset cpi", "--preset", "'cpi'"),
        ("run", "--preset smoke --preset cpi", "--preset", "'cpi'"),
        ("run", "--demos.keep-failures yes", "FLAG", "yes"),
        ("run", "stardiff", "FLAG", "stardiff"),
        ("run", "-x", "FLAG", "-x"),
        ("run", "--train.steps 0", "train.steps", 0),
        ("run", "--seed -1", "seed", -1),
        ("run", "--train.weight-decay inf", "train.weight_decay", "inf"),
        ("evaluate", "x y", "FLAG", "y"),
        ("evaluate", "x --video=False", "FLAG", "False"),
        ("evaluate", "x --eval.time-limit-s 0", "eval.time_limit_s", 0),
        ("sweep", "--trocars 1", "RUN or --policy", "none"),
        ("sweep", "x --eval.time-limit-s soon", "--eval.time-limit-s", "'soon'"),
        ("stress", "", "RUN or --policy", "none"),
        ("stress", "--policy compact --levels 1", "levels", "none"),
        ("stress", "--policy compact --disturbance rain", "disturbance", "'rain'"),
        ("run", "--demos.randomise rain=1", "demos.randomise", "'rain'"),
        ("run", "--demos.randomise smoke", "demos.randomise", "smoke"),
        ("run", "--demos.randomise smoke=1 --demos.from x", "demos.randomise", "x"),
        ("report", "--out x", "RUN", "none"),
        ("pack", "a b c", "FLAG", "c"),
        ("bench", "x --calls 0", "calls", 0),
    ],
)
def test_a_mistake_names_its_flag_and_what_came(command, typed, argument, got):
    with mistakes.of(argument, got):
        cli.dispatch([command, *typed.split()])


def test_the_nearest_flag_is_suggested():
    with mistakes.of("FLAG") as caught:
        settings("--trian.steps 3")
    assert caught.value.hint == "did you mean --train.steps?"


@pytest.mark.parametrize(
    ("typed", "heavy"),
    [
        ("run --train.stepps 3", {"jax", "mujoco", "numpy"}),
        ("run --seed -1", {"jax", "mujoco", "numpy"}),
        ("evaluate x --seed -1", {"jax", "mujoco"}),
        ("sweep x --trocars 0", {"jax", "mujoco"}),
        ("stress --policy compact --disturbance rain", {"jax", "mujoco"}),
        ("run --demos.randomise rain=1", {"jax", "mujoco", "numpy"}),
    ],
)
def test_mistakes_are_one_line_and_come_before_jax(typed, heavy):
    program = (
        "import sys\n"
        "from starjax import cli\n"
        "code = cli.guard(cli.dispatch, sys.argv[1:])\n"
        f"print(code, {heavy} & set(sys.modules))\n"
    )
    command = [sys.executable, "-c", program, *typed.split()]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.stdout.strip() == "2 set()", done.stdout
    assert len(done.stderr.strip().splitlines()) == 1 and "Traceback" not in done.stderr


def test_flags_override_the_preset_and_nothing_else():
    smoke = presets.PRESETS["smoke"]
    changed = settings("--preset=smoke --train.steps 7 --policy.unet_channels 32 --out x")
    train = dataclasses.replace(smoke.train, steps=7)
    policy = config.with_options(smoke.policy, unet_channels=(32,))
    assert changed == dataclasses.replace(smoke, train=train, policy=policy, out="x")
    assert settings("--preset smoke --seed 1 --preset paper").preset == "paper"


@pytest.mark.parametrize(
    ("typed", "folder"),
    [
        ("--preset cpu", "runs/cpu"),
        ("--preset cpu --seed=3", "runs/cpu-seed3"),
        ("--preset cpu --task reach --arm fr5 --camera side", "runs/cpu-reach-fr5-side"),
        ("--preset gpu --cameras endoscope", "runs/gpu-endoscope"),
        ("--preset gpu --cameras fixed", "runs/gpu"),
        ("--preset cpu --policy.observation state --seed 3", "runs/cpu-state-seed3"),
        ("--preset cpu --policy.observation state --seed 3 --out runs/cpu", "runs/cpu"),
        ("--preset cpu --policy.no-freeze-encoder", "runs/cpu-unfrozen"),
        (
            "--preset smoke --policy.observation image --policy.freeze-encoder "
            "--policy.encoder-weights x",
            "runs/smoke-image-frozen",
        ),
    ],
)
def test_other_scenes_observations_encoders_and_seeds_have_folders_of_their_own(typed, folder):
    assert settings(typed).out == folder


def test_a_presets_encoder_is_no_part_of_a_run_that_sees_the_state():
    policy = settings("--preset cpu --policy.observation state").policy
    assert presets.PRESETS["cpu"].policy.freeze_encoder
    assert not policy.freeze_encoder and not policy.encoder_weights
    for name, value in (("freeze_encoder", ""), ("encoder_weights", " compact")):
        with mistakes.of(f"policy.{name}", "state"):
            settings(f"--preset cpu --policy.observation state --policy.{name}{value}")


def test_a_presets_expert_is_for_its_own_task():
    assert settings("--preset cpu").demos.expert == "one_wall"
    assert settings("--preset cpu --task reach").demos.expert == ""
    assert settings("--preset cpu --task reach --demos.expert slow").demos.expert == "slow"


def test_plans_for_a_moving_target_are_shorter_unless_typed():
    assert settings("--task endoscope_track").policy.execute == 2
    assert settings("--task endoscope_track --policy.execute 4").policy.execute == 4
    assert settings("--task reach").policy.execute == settings("").policy.execute


@pytest.mark.parametrize(
    "typed", ["x/stardiff --trocars 3", "--trocars 3 x/stardiff", "--trocars=3 x/stardiff"]
)
def test_words_may_stand_before_and_after_flags(typed):
    found = sweep._parse(typed.split())
    assert (found.run, found.trocars) == ("x/stardiff", 3)


def test_a_word_that_is_empty_is_a_mistake():
    for command, argument in (
        (["run", "--out="], "--out"),
        (["evaluate", "--policy", "compact", "--out", ""], "--out"),
        (["report", ""], "RUN"),
        (["pack", "compact", ""], "OUT"),
    ):
        with mistakes.of(argument):
            cli.dispatch(command)


def helped(command, capsys, kind="--help-all"):
    """What help says: its first line, and of each flag its text."""
    with contextlib.suppress(SystemExit):
        cli.dispatch([command, kind])
    usage, *lines = capsys.readouterr().out.replace("│", " ").splitlines()
    found, entry = {}, []
    for line in lines:
        # Another name of a flag stands before it, with its values.
        if flag := re.match(r"  (?:--\w+ \[.*\]\]?, )?(--?\w[^ ,]*)", line):
            entry = found[flag[1]] = re.split(r"\s{2,}", line.strip(), maxsplit=1)[1:]
        elif line.startswith(" " * 6):
            entry.append(line.strip())
    return usage, {flag: " ".join(" ".join(entry).split()) for flag, entry in found.items()}


@pytest.mark.parametrize("command", OPTIONS)
def test_help_says_of_every_flag_something_of_its_own(command, capsys):
    _, said = helped(command, capsys)
    texts = [re.sub(r" ?\([^()]*\)$", "", text) for text in said.values()]
    # A run's are those of the learner of the preset that `auto` is here.
    is_run = OPTIONS[command] is config.RunConfig
    preset = run_settings.RunArgs(**vars(presets.resolve("auto", False)))
    settings = preset if is_run else OPTIONS[command]
    flags = [flag for flag in options.flags(settings) if not re.search(r"--(.*\.)?no-", flag)]
    assert {*said} == {*flags, "-h"}
    assert all(texts) and len({*texts}) == len(texts)
    assert not any(re.search(r"default: *(''|None)?[;)]", text) for text in said.values())


def test_help_shows_ranges_and_defaults(capsys, monkeypatch):
    said = helped("run", capsys)[1]
    usual = presets.PRESETS["cpu"].policy.options.kernel_size
    assert said["--policy.kernel-size"].endswith(f"(1, 3, ... 4095; default: {usual})")
    assert helped("sweep", capsys)[1]["--eval.time-limit-s"].endswith("(in [0.1, 86400])")
    for likely, trials, limit in ((False, 4, 30.0), (True, 30, 60.0)):
        monkeypatch.setattr(gpu, "is_likely", lambda likely=likely: likely)
        said = helped("evaluate", capsys)[1]
        assert f"default: {trials})" in said["--eval.trials"]
        assert f"default: {limit})" in said["--eval.time-limit-s"]


def text_and_flags(command, capsys):
    """What stands above the flags in the short help, and the lines with the flags."""
    with contextlib.suppress(SystemExit):
        cli.dispatch([command, "--help"])
    page = capsys.readouterr().out
    # Lines of a box, or of hyphens where the output has no such characters.
    found = re.search(r"^\W*(positional arguments|options)\b", page, re.MULTILINE)
    assert found
    return page[: found.start()], page[found.start() :].splitlines()


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_help_stays_within_the_terminal_and_breaks_no_word(command, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "1000")
    text, _ = text_and_flags(command, capsys)
    monkeypatch.setenv("COLUMNS", "40")
    wrapped, flags = text_and_flags(command, capsys)
    lines = [line for line in wrapped.splitlines()[1:] if not line.startswith(" ")]
    assert max(map(len, [*lines, *flags])) <= 40
    assert wrapped.split() == text.split()


@pytest.mark.parametrize("command", ["run", "collect", "train", "evaluate", "stress"])
def test_short_help_has_the_flags_used_most_and_points_to_the_others(command, capsys):
    few, every = (helped(command, capsys, kind)[1] for kind in ("--help", "--help-all"))
    assert {*few} < {*every} and len({*few} - {"-h"}) <= 15
    with contextlib.suppress(SystemExit):
        cli.dispatch([command, "-h"])
    assert f"starjax {command} --help-all" in capsys.readouterr().out


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_the_examples_of_help_are_command_lines(command, capsys):
    lines = text_and_flags(command, capsys)[0].splitlines()
    examples = [re.search(r"starjax (\S+) ?([^>)]*)", line) for line in lines if line[:2] == "  "]
    assert examples and all(found and found[1] == command for found in examples)
    with pytest.raises(options.Declared) as declared:
        cli.load(command)(options.DECLARE)
    for found in examples:
        assert found
        words = shlex.split(found[2])
        if issubclass(declared.value.settings, config.RunConfig):
            run_settings._settings(command, words, "", "cpu")
        else:
            options.parse(command, declared.value.settings, words, "", declared.value.default)


def test_a_tracker_is_no_setting_of_a_run_and_needs_its_extra(monkeypatch):
    monkeypatch.setattr(extras, "require", lambda *needed: asked.append(needed))
    asked = []
    assert settings("--preset smoke --track wandb") == settings("--preset smoke")
    assert asked == [("--track wandb", "wandb")]
    assert run_settings.tracker(["--track", "wandb"]) == "wandb"
    assert run_settings.tracker([]) == "none"


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        ("st", ["stress"]),
        ("run --train.st", ["--train.steps", "--train.steps-per-call", "--train.state-noise"]),
        (
            "run --task needle_",
            [
                "needle_pick",
                "needle_handover",
                "needle_regrasp",
                "needle_drive",
                "needle_drive_sh",
                "needle_drive_dial",
            ],
        ),
        ("collect --policy.learner o", ["onestep"]),
        ("evaluate --arm fr5 u", ["ur5e"]),
        ("view --compare-with e", ["expert"]),
    ],
)
def test_a_shell_completes_commands_flags_and_names(words, offered, completion_bash):
    typed = " ".join(f"'{word}'" for word in ["starjax", *words.split()])
    script = f"""
        source {completion_bash}
        COMP_WORDS=({typed}); COMP_CWORD=$((${{#COMP_WORDS[@]}} - 1)); _starjax starjax
        printf '%s\\n' "${{COMPREPLY[@]}}"
    """
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, check=True)
    assert sorted(done.stdout.split()) == sorted(offered), done.stderr


@pytest.fixture(scope="module")
def completion_bash(tmp_path_factory):
    path = tmp_path_factory.mktemp("shell") / "starjax.bash"
    with path.open("w") as stream, contextlib.redirect_stdout(stream):
        completion.main(["bash"])
    return path


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_other_shells_have_every_command_and_flag_too(shell, capsys):
    completion.main([shell])
    script = capsys.readouterr().out
    assert all(f"'{word}'" in script for word in [*cli.COMMANDS, "--train.steps", "needle_pick"])


def test_help_ends_in_a_terminal_of_a_few_columns(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "1")
    usage, said = helped("inspect", capsys)
    assert usage.startswith("usage: starjax inspect") and said


@pytest.mark.parametrize(
    ("typed", "out"),
    [
        ("--out=~/x", "/users/me/x"),
        ("--out ~/x", "/users/me/x"),
        ("--out=~", "/users/me"),
        ("--out=a~b", "a~b"),
        ("--out=~nobody-of-this-name/x", "~nobody-of-this-name/x"),
    ],
)
def test_a_tilde_is_the_home_folder(typed, out, monkeypatch):
    monkeypatch.setenv("HOME", "/users/me")
    found = options.parse("report", report_command.ReportArgs, ["~/run", *typed.split()], "")
    assert (found.run, found.out) == (("/users/me/run",), out)


@pytest.mark.parametrize(
    ("typed", "names"),
    [
        ("--method dp_ee,stardiff", ["dp_ee", "stardiff"]),
        ("--method dp_ee stardiff --seed 0", ["dp_ee", "stardiff"]),
        ("--method=stardiff,dp_ee,stardiff", ["stardiff", "dp_ee"]),
        ("--method all,stardiff_told", [*methods.TABLE_II, "stardiff_told"]),
        ("--seed 0 --method dp_ee", ["dp_ee"]),
    ],
)
def test_a_run_may_have_several_methods(typed, names):
    found = settings(f"--preset smoke {typed}")
    assert methods.selected(found.method) == names and found.out == "runs/smoke"


@pytest.mark.parametrize("typed", ["--method dp_ee,x", "--method dp_ee x", "--method dp_ee,"])
def test_each_of_several_methods_is_known(typed):
    with mistakes.of("method"):
        settings(f"--preset smoke {typed}")
    with mistakes.of("--method", "none"):
        settings("--preset smoke --method --seed 1")


def test_the_trials_of_several_trainings_may_have_one_seed():
    runs = [settings(f"--preset smoke --seed {seed} --eval.seed 5") for seed in (0, 1)]
    assert [run.seed for run in runs] == [0, 1] and [run.trial_seed for run in runs] == [5, 5]
    assert runs[0].out != runs[1].out
    assert settings("--preset smoke --seed 3").trial_seed == 3
    with mistakes.of("eval.seed", -1):
        settings("--preset smoke --eval.seed -1")
