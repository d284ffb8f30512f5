"""--benchmark: the trials of the trocar benchmark, in place of those of the flags."""

import dataclasses

import mistakes
import pytest

from starjax.cli import benchmark_args, evaluate, run_settings, stress, sweep
from starjax.evaluation import protocol
from starjax.evaluation.disturbances import DISTURBANCES

COMMANDS = {
    "evaluate": evaluate.EvaluateArgs(),
    "sweep": sweep.SweepArgs(),
    "stress": stress.StressArgs(),
}


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_runs_the_trials_of_the_protocol(command):
    args = dataclasses.replace(COMMANDS[command], benchmark=True)
    after = benchmark_args.with_trials(args, command, "reach")
    trocars = args.trocars if command == "sweep" else protocol.TROCARS
    trials = "reach", after.seed, after.eval.time_limit_s, trocars, after.eval.trials
    assert not list(protocol.departures(command, *trials))
    same = dataclasses.replace(after, benchmark=False)
    assert benchmark_args.with_trials(same, command, "needle_pick") is same


@pytest.mark.parametrize(
    ("main", "typed", "argument", "got"),
    [
        (evaluate.main, "--eval.trials 7", "eval.trials", 7),
        (stress.main, "--seed 2", "seed", 2),
        (sweep.main, "--trocars 5", "trocars", 5),
        (sweep.main, "--radii-cm 2", "radii_cm", 2.0),
    ],
)
def test_other_trials_are_refused(main, typed, argument, got):
    with mistakes.of(argument, got):
        main(["--policy", "compact", "--benchmark", *typed.split()])


def test_a_task_of_another_package_is_not_in_the_benchmark():
    args = dataclasses.replace(COMMANDS["evaluate"], benchmark=True)
    with mistakes.of("--benchmark", "knot"):
        benchmark_args.with_trials(args, "evaluate", "knot")


def test_a_sweep_of_the_benchmark_is_the_same_trials_as_by_its_flags(tmp_path):
    by_flags = dataclasses.replace(COMMANDS["sweep"])
    limit = dataclasses.replace(by_flags.eval, time_limit_s=60.0)
    by_flags = dataclasses.replace(by_flags, eval=limit)
    args = dataclasses.replace(COMMANDS["sweep"], benchmark=True)
    by_name = benchmark_args.with_trials(args, "sweep", "peg_transfer")
    assert sweep._trials(tmp_path, by_name) == sweep._trials(tmp_path, by_flags)


def test_a_stress_of_the_benchmark_has_the_levels_of_the_protocol():
    plain = COMMANDS["stress"]
    of_benchmark = dataclasses.replace(plain, benchmark=True)
    for name, level in protocol.STRESS.items():
        kind = DISTURBANCES.get(name)
        assert tuple(stress._levels(of_benchmark, kind)) == (0.0, level)
        assert stress._levels(plain, kind) == kind.levels


def test_a_run_of_the_benchmark_trains_as_its_preset_and_is_scored_by_the_protocol():
    typed = ["--preset", "cpu", "--task", "reach"]
    plain = run_settings.parse("run", typed, "")
    config = run_settings.parse("run", [*typed, "--benchmark"], "")
    trials = protocol.settings("evaluate", "reach", plain.eval)
    assert trials != plain.eval
    trials = dataclasses.replace(trials, seed=protocol.SEED)
    assert config == dataclasses.replace(plain, eval=trials)
    with mistakes.of("eval.seed", 1):
        run_settings.parse("run", [*typed, "--benchmark", "--eval.seed", "1"], "")
    other = run_settings.parse("run", [*typed, "--benchmark", "--seed", "1"], "")
    assert (other.seed, other.trial_seed) == (1, protocol.SEED)
