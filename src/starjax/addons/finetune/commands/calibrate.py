"""`starjax calibrate`: a runtime monitor for a trained policy, from trials in simulation."""

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from starjax.cli import checks, options, policy_args, session
from starjax.core import config as config_lib
from starjax.core import errors
from starjax.core.limits import Positive, Range

if TYPE_CHECKING:  # for annotations alone
    from starjax.policies.in_env import PolicyInEnv
    from starjax.policies.monitor.record import Monitor

DESCRIPTION = """Calibrates a runtime monitor and writes the policy with it to a new file.

Undisturbed trials with sampled trocars (Eq. 19) are divided into three parts. Successes of the
first scale the scores of plans and poses, those of the second set the threshold by conformal
prediction, and the third tests the false alarm rate. Rerun the same command to resume.

Examples:
  starjax calibrate --policy compact --out watched.safetensors"""


@dataclasses.dataclass(frozen=True)
class CalibrateArgs:
    """Flags of the command."""

    policy: str = "compact"  # policy.safetensors, or the name of a packaged policy
    out: str = ""  # policy file to write
    alpha: Annotated[float, Range(0.001, 0.5)] = 0.05  # false alarm rate on successes
    # simulated trials, one per sampled trocar configuration
    trials: Annotated[int, Range(20, 1_000_000)] = 2600
    # time limit of a trial in simulated seconds
    time_limit_s: Annotated[float, config_lib.TIME_LIMIT] = 60.0
    # seconds over which stillness is measured; longer than the rest that a task's success needs
    still_s: Positive = 1.6
    seed: config_lib.Seed = 1  # random seed of the trials, other than that of later evaluations


def main(argv: Sequence[str]) -> int:
    """Runs the missing trials; writes the policy file and monitor.json."""
    args, path, folder = session.for_device(
        functools.partial(_parse, argv), *session.POLICY_MODULES
    )
    started = session.start("calibrate", argv, folder)

    from starjax.addons.finetune import calibration
    from starjax.cli import policy_evaluation
    from starjax.evaluation import alarms, sweep, trials
    from starjax.policies import policy_file
    from starjax.policies.monitor import record

    who, _ = policy_args.load(path)
    settings = _score_settings(args, who)
    with started.shared() as share:
        table = policy_evaluation.rollouts(
            folder / "trials",
            who,
            sweep.sample(args.seed, args.trials, who.env.task),
            config_lib.TrialsConfig(trials=1, time_limit_s=args.time_limit_s, video_trials=0),
            args.seed,
            score_settings=settings,
        )
        if share.is_first:
            stored = policy_file.load(path.file)
            assert table.scores is not None
            fits, calibrates, tests = calibration.parts(len(table.trial))
            fitted, successes = (table.scores[table.success & part] for part in (fits, calibrates))
            test = trials.select(table, tests)
            digest = policy_file.monitor_digest(stored.params)
            monitor = calibration.calibrate(fitted, successes, args.alpha, settings, digest)
            out, is_half = Path(args.out), policy_file.is_half(stored.params)
            policy_file.save(out, stored._replace(monitor=monitor), half=is_half)
            figures = alarms.compose(test, monitor)
            content = {"policy": path.file.name, "weights": who.weights, "seed": args.seed}
            content |= {"monitor": record.to_json(monitor), "test": figures}
            started.write("monitor.json", content)
            print(_outcome(monitor, figures))
            print(f"\npolicy: {out}; figures: {folder / 'monitor.json'}")
        share.meet("over")
    return 0


def _parse(
    argv: Sequence[str], has_gpu: bool
) -> tuple[CalibrateArgs, policy_args.PolicyPath, Path]:
    """Returns the flags, the policy's file and the directory of the trials."""
    # Two cores run 120 trials in some minutes.
    default = CalibrateArgs() if has_gpu else CalibrateArgs(trials=120, time_limit_s=30.0)
    args = options.parse("calibrate", CalibrateArgs, argv, DESCRIPTION, default)
    if not args.out or Path(args.out).exists():
        raise errors.UsageError("--out", "a new file", args.out or "none")
    checks.expect_folder("directory of --out", Path(args.out).parent)
    path = policy_args.resolve(policy_args.PolicyArgs(policy=args.policy))
    trials = f"seed{args.seed}-{args.trials}x{args.time_limit_s:g}s"
    return args, path, path.folder("calibrate", [trials])


def _score_settings(args: CalibrateArgs, who: "PolicyInEnv") -> Any:
    from starjax.policies.monitor.scores import ScoreSettings

    execute, control_hz = who.trained.policy.execute, who.env.control_hz
    return ScoreSettings(execute, control_hz, max(1, round(args.still_s * control_hz / execute)))


def _outcome(monitor: "Monitor", figures: dict[str, Any]) -> str:
    """Returns the thresholds, and the realised false alarm rate with its interval."""
    from starjax.policies.monitor.scores import NAMES

    limit = dict(zip(NAMES, monitor.limits))
    false, still_s = figures["false_alarms"], monitor.settings.still_s
    lines = [
        f"\n  threshold from {monitor.count} successes at alpha {monitor.alpha:g}:",
        f"    successive plans     more than {1e3 * limit['conflict']:.2f} mm apart",
        f"    tip                  less than {-1e3 * limit['stillness']:.2f} mm in {still_s:.1f} s",
        f"    progress             {limit['progress']:.1f} s (clock alone {monitor.clock_s:.1f} s)",
        f"    jaws                 closed to less than {-limit['closure']:.2f} of -1 to 1",
    ]
    if false["trials"]:
        low, high = (100 * bound for bound in false["ci95"])
        count = f"{false['successes']}/{false['trials']} = {100 * false['rate']:.1f}%"
        lines.append(f"  false alarms         {count} [{low:.1f}, {high:.1f}] of fresh successes")
    announced = figures["before_clock"]
    lines.append(
        f"  failures             {announced['successes']}/{announced['trials']} before the clock"
    )
    return "\n".join(lines)
