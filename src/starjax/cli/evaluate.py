"""`starjax evaluate`: scores a trained policy on its task's trocars."""

import dataclasses
import functools
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starjax.cli import (
    benchmark_args,
    messages,
    options,
    policy_args,
    scenes,
    session,
)
from starjax.cli.folders import is_under_way
from starjax.core import config as config_lib
from starjax.core import config_json, errors, extras, methods
from starjax.runtime import files

if TYPE_CHECKING:  # for annotations alone
    from starjax.evaluation import result as result_file
    from starjax.policies.in_env import PolicyInEnv

DESCRIPTION = """Scores a trained policy on its task's trocars and records a video.

RUN is the directory of a method, such as runs/cpu/stardiff. --policy takes a policy.safetensors or
the name of a packaged policy instead, or ws://HOST:PORT of a server (starjax serve,
or openpi's with a scene in its metadata). Trials and time limit come from the flags below, not from
RUN; their defaults depend on this machine. Rerun the same command to resume.

Examples:
  starjax evaluate --policy compact
  starjax evaluate runs/cpu/stardiff --arm fr5 --eval.trials 10"""


@dataclasses.dataclass(frozen=True)
class EvaluateArgs(benchmark_args.BenchmarkArgs, policy_args.PolicyArgs):
    """Flags of the command."""

    seed: config_lib.Seed = 0  # random seed of the trials
    # options of the learner instead of those of the training, such as temperature=0.1 or onestep's
    # correct_at=0.3
    sampling: tuple[str, ...] = ()
    # executed commands of a plan instead of those of the training, 0 for these. Success that falls
    # with fewer means that the policy waits where its demonstrations stood still
    execute: config_lib.CountOrZero = 0
    out: str = options.AUTO  # directory of the result; auto: one in RUN or in runs/evaluate
    video: bool = True  # write rollout.mp4
    eval: config_lib.TrialsConfig = dataclasses.field(default_factory=config_lib.TrialsConfig)


def main(argv: Sequence[str]) -> int:
    """Runs the missing trials; writes result.json and rollout.mp4."""
    args, path, folder = session.for_device(
        functools.partial(_parse, argv), *session.POLICY_MODULES
    )
    from starjax.cli import plan_text, policy_evaluation, stage_times

    who, config = policy_args.load(path)
    args = benchmark_args.with_trials(args, "evaluate", who.env.names.task)
    started = session.start("evaluate", argv, folder)
    method, scene = who.trained.method, scenes.settings(who.env.names)
    config = dataclasses.replace(
        config,
        method=method,
        out=str(folder),
        scene=scene,
        eval=config_lib.EvalConfig(**vars(args.eval)),
    )
    name = args.policy or args.run
    with started.shared() as share:
        resumes = share.first("same", lambda: _is_same(folder, who, args, scene))
        about = plan_text.about_served if path.address else plan_text.about
        print(f"{about(config, name, args.seed)}, into {folder}\n", flush=True)
        with stage_times.timed(folder, "evaluate", resumes or is_under_way(folder)):
            table = policy_evaluation.rollouts(
                folder / "evaluation", who, who.env.task.trocars, args.eval, args.seed
            )
        if share.is_first:
            times = stage_times.read(folder)
            result = policy_evaluation.write_result(
                folder, who, table, config, args.seed, started.command, times
            )
            print(f"\n{messages.outcome([result])}\n{_times(result)}")
            if "alarms" in result.about:
                print(f"  {messages.alarms(result.about['alarms'])}")
            print()
            if not resumes:
                (folder / "rollout.mp4").unlink(missing_ok=True)  # shows other trials
            if args.video:
                print(_record_video(folder, method))
            hint = f"starjax report {shlex.quote(str(folder))} draws tables and figures"
            print(f"result: {folder / 'result.json'}; {hint}")
        share.meet("over")
    return 0


def _parse(argv: Sequence[str], has_gpu: bool) -> tuple[EvaluateArgs, policy_args.PolicyPath, Path]:
    """Returns the flags, the policy's files and the directory of the result."""
    # Two cores run 48 trials in some minutes, a GPU the paper's 360.
    small = config_lib.TrialsConfig(trials=4, time_limit_s=30.0)
    default = EvaluateArgs() if has_gpu else EvaluateArgs(eval=small)
    args = options.parse("evaluate", EvaluateArgs, argv, DESCRIPTION, default)
    if args.video:
        extras.require("evaluate --video", "report", "video")
    benchmark_args.check(args, default)
    path = policy_args.resolve(args)._replace(
        sampling=policy_args.sampling(args.sampling), execute=args.execute
    )
    if path.address and (args.sampling or args.execute):
        flag = policy_args.SAMPLING if args.sampling else "--execute"
        raise errors.UsageError(flag, "a file's policy", path.address)
    trials = f"seed{args.seed}-{args.eval.trials}x{args.eval.time_limit_s:g}s"
    trials = benchmark_args.label() if args.benchmark else trials
    samples = [word.replace("=", "") for word in args.sampling]
    samples += [f"execute{args.execute}"] * bool(args.execute)
    parts = [*samples, trials, *["ensemble"] * args.eval.ensemble]
    return args, path, path.folder("evaluate", parts, args.out)


def _is_same(
    folder: Path, who: "PolicyInEnv", args: EvaluateArgs, scene: config_lib.SceneConfig
) -> bool:
    """Returns True if the directory's result has this policy and these trials.

    Raises:
      errors.UsageError: the directory of --out holds results that would be lost.
    """
    before, weights = _previous(folder), who.weights
    if args.out != options.AUTO:
        _refuse_foreign(folder, before.get("weights", weights) == weights)
    trials = dataclasses.asdict(config_lib.EvalConfig(**vars(args.eval)))
    policy = config_json.as_json(who.trained.policy)
    has_same_policy = policy == (before.get("config") or {}).get("policy")
    return has_same_policy and _identity(before) == (weights, args.seed, list(scene.arm), trials)


def _previous(folder: Path) -> dict[str, Any]:
    """Returns the content of an earlier result.json, empty if it is missing or damaged."""
    try:
        return files.read_json(folder / "result.json")
    except (FileNotFoundError, ValueError):
        return {}


def _identity(result: dict[str, Any]) -> tuple[Any, Any, Any, Any]:
    """Returns weights, seed, arms and settings of a result's trials."""
    config = result.get("config") or {}
    arms = (config.get("scene") or {}).get("arm")
    trials = (config.get("eval") or {}) | {"seed": None}
    return result.get("weights"), result.get("seed"), arms, trials


def _refuse_foreign(folder: Path, has_same_weights: bool) -> None:
    """Raises UsageError for the directory of a run, or of a result of other weights."""
    if any(any(folder.glob(name)) for name in ("config.json", "demos-*", "*/config.json")):
        raise errors.UsageError("--out", "a directory without a run", folder)
    if not has_same_weights:
        raise errors.UsageError(
            "--out",
            "a directory without a result of other weights",
            folder,
            "choose another or remove that one",
        )


def _times(result: "result_file.Result") -> str:
    """Returns a line with the durations of a successful trial and of an inference."""
    steps = result.figures["steps"]["median"]
    success = "-" if steps is None else f"{steps / result.control_hz:.1f} s"
    return f"  median success {success}, inference {result.about['inference_ms']['p50']:.1f} ms"


def _record_video(folder: Path, method: str) -> str:
    """Writes the video of the recorded trials; returns a line for the user."""
    from starjax.report import results, video

    try:
        path = video.record([results.load(folder)], folder / "rollout.mp4")
    except (OSError, RuntimeError) as error:  # the encoder is a program of its own
        return f"no video: {error}"
    label = methods.SCORED[method].label
    return f"video: {path}" if path else f"no video: no recorded trial of {label}"
