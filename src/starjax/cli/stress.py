"""`starjax stress`: scores a trained policy under disturbances, one at a time."""

import dataclasses
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starjax.cli import benchmark_args, messages, options, policy_args, scenes, session
from starjax.core import config as config_lib
from starjax.core import errors, extras
from starjax.core.limits import NotNegative
from starjax.core.registry import Rows
from starjax.evaluation import disturbances, protocol
from starjax.runtime import files

if TYPE_CHECKING:  # for annotations alone
    from starjax.policies.in_env import PolicyInEnv

DESCRIPTION = """Scores a trained policy on its task's trocars under disturbances.

RUN is the directory of a method, such as runs/cpu/stardiff. --policy takes a policy.safetensors or
the name of a packaged policy instead. Nothing is retrained. Each disturbance has several levels,
the first of which is zero; all levels run the same trials. Rerun the same command to resume.

Examples:
  starjax stress --policy compact --disturbance breathing smoke
  starjax stress --policy compact --disturbance camera=5 blood=0.05
  starjax stress runs/cpu/stardiff --disturbance trocar_offset --levels 0 0.005"""


_RECORDED = "recorded.npz"
_TRIALS = config_lib.TrialsConfig(trials=4, time_limit_s=30.0)


@dataclasses.dataclass(frozen=True)
class StressArgs(benchmark_args.BenchmarkArgs, policy_args.PolicyArgs):
    """Flags of the command."""

    # disturbances to test, NAME or NAME=LEVEL for 0 and that level; default: all that apply to this
    # policy
    disturbance: tuple[str, ...] = ()
    # levels of a single disturbance, in its unit; default: its own
    levels: tuple[NotNegative, ...] = ()
    together: tuple[str, ...] = ()  # NAME=LEVEL of disturbances to test at once as well
    seed: config_lib.Seed = 0  # random seed of the trials
    # directory of the result; auto: one in RUN or in runs/stress
    out: str = options.AUTO
    eval: config_lib.TrialsConfig = _TRIALS


def main(argv: Sequence[str]) -> int:
    """Runs the missing trials; writes stress.json and its page."""
    args = options.parse("stress", StressArgs, argv, DESCRIPTION)
    benchmark_args.check(args, StressArgs())
    path = policy_args.resolve(args)
    trials = benchmark_args.label() if args.benchmark else f"seed{args.seed}"
    folder = path.folder("stress", [trials], args.out)
    chosen = disturbances.chosen_levels("disturbance", args.disturbance)
    if args.levels and (len(chosen) != 1 or any(chosen.values())):
        got = ", ".join(args.disturbance) or "none"
        raise errors.UsageError("levels", "exactly one --disturbance, without a level", got)
    args = dataclasses.replace(args, disturbance=tuple(chosen))
    started = session.start("stress", argv, folder)
    together = disturbances.parse_levels("together", args.together)
    who, _ = policy_args.load(path)
    args = benchmark_args.with_trials(args, "stress", who.env.names.task)
    kinds = _kinds(args, chosen, who.trained.policy.observation, who.env.names.tools)
    _check_together(together, list(kinds))
    who = _disturbed(who, list(kinds))
    content = {
        "benchmark_version": protocol.VERSION,
        "scene": who.env.names._asdict(),
        "method": who.trained.method,
        "weights": who.weights,
        **({"server": who.server.origin} if who.server else {}),
        "seed": args.seed,
        "trials_at_each_trocar": args.eval.trials,
        "time_limit_s": args.eval.time_limit_s,
        "disturbances": {},
    }
    with started.shared() as share:
        for name, kind in kinds.items():
            print(f"{name}: {kind.description}", flush=True)
            rows = {"what": kind.description, "unit": kind.unit, "levels": {}}
            content["disturbances"][name] = rows
            for level in args.levels or chosen.get(name) or _levels(args, kind):
                levels = {**dict.fromkeys(kinds, 0.0), name: level}
                score = _score(_folder(folder, levels), who, levels, args)
                rows["levels"][f"{level:g}"] = score
                print(_line(f"{level:g} {kind.unit}", score), flush=True)
                if share.is_first:
                    started.write("stress.json", content)
        if together:
            levels = {**dict.fromkeys(kinds, 0.0), **together}
            score = _score(_folder(folder, together), who, levels, args)
            content["together"] = {"levels": together, **score}
            print(f"{' '.join(args.together)}\n{_line('together', score)}", flush=True)
        if share.is_first:
            started.write("stress.json", content)
            _draw(folder)
        print(f"\nresult: {folder / 'stress.json'}")
    return 0


def _draw(folder: Path) -> None:
    """Writes the page, the table and the figure if the extra `report` is installed."""
    if extras.missing("report"):
        return
    from starjax.report import stress_page

    content = files.read_json(folder / "stress.json")
    for name, data in stress_page.files(content, _failed(folder, content)).items():
        files.write_bytes(folder / name, data)
    print(f"\nreport: {folder / 'index.html'}")


def _failed(folder: Path, content: Mapping[str, Any]) -> list[list[str]]:
    """Makes a row per level with failed trials, with the command that shows its recorded ones."""
    levels = [
        (name, level, score, _folder(folder, {name: float(level)}))
        for name, kind in content["disturbances"].items()
        for level, score in kind["levels"].items()
    ]
    if at_once := content.get("together"):
        levels.append(("together", "", at_once, _folder(folder, at_once["levels"])))
    rows = [["Disturbance", "Level", "Trials, as trocar-trial", "Command"]]
    for name, level, score, trials in levels:
        if score["failed"]:
            names = ", ".join(f"{trocar}-{trial}" for trocar, trial in score["failed"])
            file = shlex.quote(str(trials / _RECORDED))
            shown = f"starjax view --trials {file}" if (trials / _RECORDED).is_file() else ""
            rows.append([name, level, names, shown])
    return rows if len(rows) > 1 else []


def _folder(folder: Path, levels: Mapping[str, float]) -> Path:
    """Returns the directory of the trials at levels of disturbances; level 0 is shared by all."""
    names = [f"{name}-{level:g}" for name, level in levels.items() if level]
    return folder / ("-".join(names) or "0")


def _kinds(
    args: StressArgs,
    chosen: Mapping[str, Sequence[float]],
    observation: str,
    tools: Sequence[str],
) -> dict[str, Any]:
    """Returns the requested disturbances, by default all that apply to observation and tools.

    Raises:
      errors.UsageError: a disturbance of images is requested for a policy without images, one of
        wrists for tools without any, or a level that a disturbance does not have.
    """
    from starjax.evaluation.disturbances import base

    registry = disturbances.DISTURBANCES
    kinds = {name: registry.get(name) for name in args.disturbance}
    kinds = kinds or dict(Rows(registry))  # without those of broken packages
    for name in args.disturbance:
        if observation != "image" and kinds[name].image_only:
            raise errors.UsageError("disturbance", "one that applies to states", name)
        base.check_tools("disturbance", name, tools)
        base.check_levels("levels", name, args.levels)
        base.check_levels("disturbance", name, chosen[name])
    kinds = {name: kind for name, kind in kinds.items() if base.suits(kind, tools)}
    return {n: kind for n, kind in kinds.items() if observation == "image" or not kind.image_only}


def _levels(args: StressArgs, kind: Any) -> Sequence[float]:
    """Returns the default levels of a disturbance; with --benchmark, zero and the highest."""
    return (0.0, kind.levels[-1]) if args.benchmark else kind.levels


def _check_together(levels: dict[str, float], tested: list[str]) -> None:
    """Checks the disturbances that are tested at once.

    Raises:
      errors.UsageError: one of them is not tested alone, or has no such level.
    """
    from starjax.evaluation.disturbances import base

    for name, level in levels.items():
        errors.choice("together", name, tested)
        base.check_levels("together", name, [level])


def _disturbed(who: "PolicyInEnv", names: list[str]) -> Any:
    """Returns the policy in an environment whose one program has every level of all of these."""
    from starjax.evaluation.disturbances import base

    env = scenes.disturbable(who.env, names, who.trained.policy)
    return who._replace(env=base.with_disturbances(env, names))


def _score(
    folder: Path, who: "PolicyInEnv", levels: dict[str, float], args: StressArgs
) -> dict[str, Any]:
    """Returns success, RCM error, force on the abdominal wall and alarms in a level's trials."""
    from starjax.cli import policy_evaluation
    from starjax.evaluation import alarms, statistics, wall

    trocars = who.env.task.trocars
    table = policy_evaluation.rollouts(folder, who, trocars, args.eval, args.seed, levels)
    monitor = policy_evaluation.monitor_of(who, args.eval)
    return {
        "strict": statistics.rate(table.success),
        "safe": statistics.rate(table.safe),
        "invalid": int(table.invalid.sum()),
        "failed": list(
            zip(*(column[~table.success].tolist() for column in (table.trocar, table.trial)))
        ),
        "rcm_error_mm": statistics.rcm_error_mm(table),
        "wall_force_N": wall.force(table, who.env.control_hz),
        **({"alarms": alarms.compose(table, monitor)} if monitor else {}),
    }


def _line(level: str, score: dict[str, Any]) -> str:
    strict, errors_mm = score["strict"], score["rcm_error_mm"]["executed"]
    rate = f"{strict['successes']}/{strict['trials']} = {100 * strict['rate']:.0f}%"
    error = f"RCM error {errors_mm['mean']:.3f} mm, p99 {errors_mm['p99']:.2f}"
    line = f"  {level:10} {rate:16} {error}; wall {score['wall_force_N']['p99']:.2f} N"
    return f"{line}\n{'':13}{messages.alarms(score['alarms'])}" if "alarms" in score else line
