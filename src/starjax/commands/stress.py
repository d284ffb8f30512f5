"""`starjax stress`: what breaks a trained policy, one disturbance at a time."""

import dataclasses
import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from starjax import config as config_lib
from starjax import errors
from starjax.commands import checks, options, policy_args, scenes
from starjax.evaluation import disturbances
from starjax.limits import Count, CountOrZero, NotNegative
from starjax.runtime import files, xla

DESCRIPTION = """Scores a trained policy on its task's trocars while something is wrong.

RUN is a method's folder, such as runs/cpu/stardiff; or --policy names a policy.safetensors, or a
policy that ships with starjax. Nothing is trained again. Each disturbance has levels, the first
of which is none, and every level runs the same trials. The same command again goes on from the
trials that are done."""


# The fields of `config.EvalConfig`, with other defaults.
@dataclasses.dataclass(frozen=True, kw_only=True)
class Trials:
    """Closed-loop trials of a level."""

    trials: Count = 4  # trials at each trocar
    # s of simulated time that a trial may take
    time_limit_s: Annotated[float, config_lib.TIME_LIMIT] = 30.0
    chunk: CountOrZero = 0  # trials between two savings, at most; 0: as many as a program runs
    video_trials: CountOrZero = 0  # trials whose joint positions are recorded


@dataclasses.dataclass(frozen=True)
class Options:
    """Flags of the command."""

    run: options.RunOrNone = ""  # a method's folder, such as runs/cpu/stardiff
    # a policy.safetensors, or the name of a policy that ships with starjax, instead of RUN
    policy: str = ""
    arm: tuple[str, ...] = ()  # robots to score it with; left out: those it was trained with
    disturbance: tuple[str, ...] = ()  # which ones; left out: all that this policy can meet
    # of one disturbance, in its unit; left out: its usual ones
    levels: tuple[NotNegative, ...] = ()
    seed: config_lib.Seed = 0  # of the trials
    # folder of the result; auto: RUN/stress or one in runs/stress
    out: str = options.AUTO
    eval: Trials = dataclasses.field(default_factory=Trials)


def main(argv: Sequence[str]) -> int:
    """Runs the trials that are missing; writes stress.json, its table and its figure."""
    chosen = options.parse(Options, argv, prog="starjax stress", description=DESCRIPTION)
    named = policy_args.resolve(chosen.run, chosen.policy)
    folder = _folder(named, chosen)
    if chosen.levels and len(chosen.disturbance) != 1:
        raise errors.UsageError("levels", "one --disturbance beside it", "none or several")
    names = tuple(disturbances.resolve("disturbance", chosen.disturbance))
    chosen = dataclasses.replace(chosen, disturbance=names)
    xla.prepare_xla()
    xla.require_devices("starjax.commands.policy_evaluation")
    files.require_writable(folder)
    who, _ = policy_args.load(named, chosen.arm)
    kinds = _kinds(chosen, who.trained.policy.observation)
    who = _disturbed(who, list(kinds))
    found: dict[str, Any] = {}
    for name, kind in kinds.items():
        print(f"{name}: {kind.description}", flush=True)
        rows = found[name] = {"what": kind.description, "unit": kind.unit, "levels": {}}
        for level in chosen.levels or kind.levels:
            place = folder / (f"{name}-{level:g}" if level else "0")
            score = _score(place, who, {**dict.fromkeys(kinds, 0.0), name: level}, chosen)
            rows["levels"][f"{level:g}"] = score
            print(_line(f"{level:g} {kind.unit}", score), flush=True)
            files.write_json(folder / "stress.json", _content(who, chosen, argv, found))
    _draw(folder, _content(who, chosen, argv, found))
    print(f"\nresult: {folder / 'stress.json'}")
    return 0


def _draw(folder: Path, content: dict[str, Any]) -> None:
    """Writes the table and the figure, where what draws is installed."""
    if importlib.util.find_spec("matplotlib") is None:
        return
    from starjax.report import stress

    for name, data in stress.files(content).items():
        files.write_bytes(folder / name, data)


def _folder(named: policy_args.PolicyPath, chosen: Options) -> Path:
    parts = [*chosen.arm, f"seed{chosen.seed}"]
    if named.run:
        default = named.run / "-".join(["stress", *parts])
    else:
        default = Path("runs/stress") / "-".join([policy_args.label(named.file), *parts])
    folder = default if chosen.out == options.AUTO else chosen.out
    checks.expect_folder("--out", folder)
    return Path(folder)


def _kinds(chosen: Options, observation: str) -> dict[str, Any]:
    """The disturbances that are asked for, or all that a policy with this observation can meet.

    Raises:
      errors.UsageError: the policy sees no images for one to change, or one has no such level.
    """
    from starjax.evaluation.disturbances import base

    known = disturbances.DISTURBANCES
    kinds = {name: known.get(name) for name in chosen.disturbance or known.names()}
    meets = {n: kind for n, kind in kinds.items() if observation == "image" or not kind.image_only}
    for name in chosen.disturbance:
        if name not in meets:
            raise errors.UsageError("disturbance", "one that a policy of states meets", name)
        base.check_levels("levels", name, chosen.levels)
    return meets


def _disturbed(who: Any, names: list[str]) -> Any:
    """The policy where all of these may be wrong: one program has every level of each."""
    from starjax.evaluation.disturbances import base

    env = scenes.disturbable(who.env, names, who.trained.policy)
    return who._replace(env=base.with_disturbances(env, names))


def _score(place: Path, who: Any, levels: dict[str, float], chosen: Options) -> dict[str, Any]:
    """Success, RCM error and the force on the abdominal wall in all trials of a level."""
    from starjax.commands import policy_evaluation
    from starjax.evaluation import statistics, wall

    trials = config_lib.EvalConfig(**vars(chosen.eval))
    trocars = who.env.task.trocars
    table = policy_evaluation.rollouts(place, who, trocars, trials, chosen.seed, levels)
    return {
        "strict": statistics.rate(table.success),
        "safe": statistics.rate(table.safe),
        "invalid": int(table.invalid.sum()),
        "rcm_error_mm": statistics.rcm_error_mm(table),
        "wall_force_N": wall.force(table, who.env.control_hz),
    }


def _line(level: str, score: dict[str, Any]) -> str:
    won, errors_mm = score["strict"], score["rcm_error_mm"]["executed"]
    rate = f"{won['successes']}/{won['trials']} = {100 * won['rate']:.0f}%"
    error = f"RCM error {errors_mm['mean']:.3f} mm, p99 {errors_mm['p99']:.2f}"
    return f"  {level:10} {rate:16} {error}; wall {score['wall_force_N']['p99']:.2f} N"


def _content(
    who: Any, chosen: Options, argv: Sequence[str], found: dict[str, Any]
) -> dict[str, Any]:
    from starjax.runtime import jax_settings, provenance

    return {
        "scene": who.env.names._asdict(),
        "method": who.trained.method,
        "weights": who.weights,
        "seed": chosen.seed,
        "trials_at_each_trocar": chosen.eval.trials,
        "time_limit_s": chosen.eval.time_limit_s,
        "command": options.typed("stress", argv),
        "disturbances": found,
        **provenance.code()._asdict(),
        "versions": xla.versions(),
        "hardware": xla.hardware(),
        **jax_settings.record(),
    }
