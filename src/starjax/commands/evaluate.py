"""`starjax evaluate`: a trained policy on the twelve trocars; a file of weights is enough."""

import dataclasses
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from starjax import config as config_lib
from starjax import errors, methods
from starjax.commands import checks, folders, messages, options, policy_args, scenes, stage_times
from starjax.runtime import files, gpu, xla

DESCRIPTION = """Scores a trained policy on its task's trocars, and films it.

RUN is a method's folder, such as runs/cpu/stardiff; or --policy names a policy.safetensors, from
anywhere, or a policy that ships with starjax. Trials and their time limit are those that the flags
say, and else the defaults below, which are for this machine, not those of RUN. The same command
again goes on from the trials that are done."""


@dataclasses.dataclass(frozen=True)
class Options:
    """Flags of the command."""

    run: options.RunOrNone = ""  # a method's folder, such as runs/cpu/stardiff
    # a policy.safetensors, or the name of a policy that ships with starjax, instead of RUN
    policy: str = ""
    arm: tuple[str, ...] = ()  # robots to score it with; left out: those it was trained with
    seed: config_lib.Seed = 0  # of the trials
    # folder of the result; auto: one in RUN or in runs/evaluate
    out: str = options.AUTO
    video: bool = True  # write rollout.mp4
    eval: config_lib.EvalConfig = dataclasses.field(default_factory=config_lib.EvalConfig)


def main(argv: Sequence[str]) -> int:
    """Runs the trials that are missing; writes result.json and rollout.mp4."""
    guess = gpu.is_likely()
    asked = _asked(argv, guess)  # a mistake should not wait for jax
    xla.prepare_xla()
    from starjax.runtime import processes

    processes.join()
    xla.require_devices("starjax.commands.policy_evaluation")
    chosen, named, folder = asked if gpu.is_used() == guess else _asked(argv, not guess)

    from starjax.commands import policy_evaluation
    from starjax.rollouts import sharing

    who, config = policy_args.load(named, chosen.arm)
    scene = scenes.settings(who.env.names)
    changed = {
        "method": who.trained.method,
        "out": str(folder),
        "scene": scene,
        "eval": chosen.eval,
    }
    config = dataclasses.replace(config, **changed)
    about = messages.about(config, chosen.policy or chosen.run, chosen.seed)
    with sharing.shared(folder) as share, messages.first_process_only(share.is_first):
        same = share.first("same", lambda: _goes_on(folder, who.weights, chosen, scene))
        print(f"{about}, into {folder}\n", flush=True)
        with stage_times.timed(folder, "evaluate", same or folders.is_under_way(folder)):
            table = policy_evaluation.rollouts(
                folder / "evaluation", who, who.env.task.trocars, chosen.eval, chosen.seed
            )
        if share.is_first:
            command = options.typed("evaluate", argv)
            result = policy_evaluation.write_result(
                folder, who, table, config, chosen.seed, command, stage_times.read(folder)
            )
            print(f"\n{messages.outcome([result])}\n{_times(result)}\n")
            if not same:
                (folder / "rollout.mp4").unlink(missing_ok=True)  # of other trials
            if chosen.video:
                print(_film(folder, who))
            hint = f"starjax report {shlex.quote(str(folder))} draws tables and figures"
            print(f"result: {folder / 'result.json'}; {hint}")
        share.meet("over")
    return 0


def _goes_on(folder: Path, weights: str, chosen: Options, scene: config_lib.SceneConfig) -> bool:
    """Whether the folder's result is of these weights and trials; refuses what it must not hold."""
    before = _before(folder)
    if chosen.out != options.AUTO:
        _refuse_foreign(folder, before.get("weights", weights) == weights)
    arms = list(scene.arm)
    return _identity(before) == (weights, chosen.seed, arms, dataclasses.asdict(chosen.eval))


def _asked(argv: Sequence[str], has_gpu: bool) -> tuple[Options, policy_args.PolicyPath, Path]:
    """Parses the command line: its flags, the policy, the result's folder."""
    chosen = options.parse(
        Options, argv, prog="starjax evaluate", description=DESCRIPTION, default=_default(has_gpu)
    )
    named = policy_args.resolve(chosen.run, chosen.policy)
    if named.run:
        default = Path(chosen.run) / f"evaluate-{_trials(chosen)}"
    else:
        default = Path("runs/evaluate") / f"{policy_args.label(named.file)}-{_trials(chosen)}"
    folder = default if chosen.out == options.AUTO else chosen.out
    checks.expect_folder("--out", folder)
    return chosen, named, Path(folder)


def _default(has_gpu: bool) -> Options:
    """Two cores get through 48 trials in the time of a coffee, a GPU through the paper's 360."""
    if has_gpu:
        return Options()
    return Options(eval=config_lib.EvalConfig(trials=4, time_limit_s=30.0))


def _trials(chosen: Options) -> str:
    """A name for an evaluation's trials, so that others do not replace them."""
    trials = f"seed{chosen.seed}-{chosen.eval.trials}x{chosen.eval.time_limit_s:g}s"
    return "-".join([*chosen.arm, trials, *["ensemble"] * chosen.eval.ensemble])


def _before(folder: Path) -> dict[str, Any]:
    """The result that is there; of a damaged one nothing."""
    try:
        return files.read_json(folder / "result.json")
    except (FileNotFoundError, ValueError):
        return {}


def _identity(result: dict[str, Any]) -> tuple[Any, Any, Any, Any]:
    """Identifies the trials of a result: whose they are, and which."""
    config = result.get("config") or {}
    arms = (config.get("scene") or {}).get("arm")
    # Older results lack what was added since.
    trials = dataclasses.asdict(config_lib.EvalConfig()) | (config.get("eval") or {})
    return result.get("weights"), result.get("seed"), arms, trials


def _refuse_foreign(folder: Path, is_ours: bool) -> None:
    """Raises UsageError for a folder in which something else would be lost or hidden."""
    held = [what for what in ("config.json", "demos-*", "*/config.json") if any(folder.glob(what))]
    if held:
        raise errors.UsageError("--out", "a folder of its own", f"a run's, {folder}")
    if not is_ours:
        raise errors.UsageError(
            "--out",
            "a folder without a result of other weights",
            folder,
            "choose another, or remove that one",
        )


def _times(result: Any) -> str:
    """How long a success and a decision take."""
    steps = result.figures["steps"]["median"]
    success = "-" if steps is None else f"{steps / result.control_hz:.1f} s"
    return f"  median success {success}, decision {result.about['inference_ms']['p50']:.1f} ms"


def _film(folder: Path, who: Any) -> str:
    """Writes the video of the recorded trials; says where, or why not."""
    from starjax.report import results, video

    try:
        path = video.record([results.load(folder)], folder / "rollout.mp4")
    except (OSError, RuntimeError) as error:  # the encoder is a program of its own
        return f"no video: {error}"
    method = methods.METHODS[who.trained.method].label
    return f"video: {path}" if path else f"no video: no trial of {method} was recorded"
