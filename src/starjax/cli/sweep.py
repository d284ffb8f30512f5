"""`starjax sweep`: scores a trained policy on a sample or a grid of trocars."""

import dataclasses
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from starjax.cli import benchmark_args, checks, folders, messages, options, policy_args, session
from starjax.core import config as config_lib
from starjax.core.limits import CountOrZero, Range
from starjax.runtime import files

if TYPE_CHECKING:  # for annotations alone
    from starjax.sim.task import Task

DESCRIPTION = """Scores a trained policy on a random sample (Eq. 19) or a grid of trocars.

RUN is the directory of a method, such as runs/cpu/stardiff. --policy takes a policy.safetensors or
the name of a packaged policy instead. The command writes sweep.json to RUN, where the report draws
it as the success map and Fig. 4; with --arm or --policy, to a directory that it prints. Trials of
all sweeps are kept next to it: rerun the same command to resume.

Examples:
  starjax sweep --policy compact --trocars 500
  starjax sweep runs/cpu/stardiff --radii-cm 0 1 2 3 --azimuths 8"""

MAX_TROCARS = 1_000_000  # larger values are typos
Several = Annotated[int, Range(1, MAX_TROCARS)]


# Fields of `config.TrialsConfig` with other defaults.
@dataclasses.dataclass(frozen=True, kw_only=True)
class SweepTrials:
    """Closed-loop trials."""

    trials: Several = 1  # trials per trocar
    # time limit of a trial in simulated seconds; default: that of RUN, else 60
    time_limit_s: Annotated[float | None, config_lib.TIME_LIMIT] = None
    chunk: CountOrZero = 0  # trials per saved chunk; 0: one full batch
    video_trials: CountOrZero = 0  # trials whose joint positions are recorded


@dataclasses.dataclass(frozen=True)
class SweepArgs(benchmark_args.BenchmarkArgs, policy_args.PolicyArgs):
    """Flags of the command."""

    trocars: Several = 200  # number of sampled trocars; unused with a grid
    # grid: distances from the nominal trocar in cm, 0 is a single point; default: no grid
    radii_cm: Annotated[tuple[float, ...], Range(0.0, 10.0)] = ()
    # grid: polar angles in degrees, 0 points straight up
    polars_deg: Annotated[tuple[float, ...], Range(0.0, 180.0)] = (90.0,)
    azimuths: Several = 12  # grid: number of equally spaced azimuths
    seed: config_lib.Seed = 0  # random seed of the sample and the trials
    eval: SweepTrials = dataclasses.field(default_factory=SweepTrials)


def main(argv: Sequence[str]) -> int:
    """Runs the missing trials; writes sweep.json."""
    args = _parse(argv)
    path = policy_args.resolve(args)
    if args.eval.time_limit_s is None:
        limit = dataclasses.replace(args.eval, time_limit_s=_time_limit_s(path.run))
        args = dataclasses.replace(args, eval=limit)
    folder = _folder(path)
    started = session.start("sweep", argv, folder)

    from starjax.cli import policy_evaluation
    from starjax.evaluation import result, sweep
    from starjax.runtime import processes
    from starjax.sim.rollouts import trocars

    who, config = policy_args.load(path)
    task = who.env.task
    args = benchmark_args.with_trials(args, "sweep", task.name)
    points = _trocars(args, task)
    trials = config_lib.TrialsConfig(**vars(args.eval))
    table = policy_evaluation.rollouts(_trials(folder, args), who, points, trials, args.seed)
    if not processes.is_first():
        return 0
    seen = trocars.select(task.trocars, slice(config.demos.seen_trocars))
    figures = sweep.compose(table, seen, who.env.p_world_ref, seed=args.seed)
    about = {
        "method": who.trained.method,
        "observation": who.trained.policy.observation,
        "command": started.command,
        "weights": who.weights,
        "control_hz": who.env.control_hz,
        "seed": args.seed,
        "time_limit_s": args.eval.time_limit_s,
    }
    result.write(folder / "sweep.json", who.env.names, figures, about)
    print(_outcome(figures))
    hint = f"; {messages.hint(folder, who.weights, 'draws')}" if folder == path.run else ""
    print(f"\nresult: {folder / 'sweep.json'}{hint}")
    return 0


def _time_limit_s(run: Path | None) -> float:
    """Returns the time limit of a run's trials, or the default of a policy file.

    The run's result has it, which later commands do not change; without a result, the settings of
    the last command.
    """
    if run is None:
        return config_lib.TrialsConfig.time_limit_s
    try:
        return float(files.read_json(run / "result.json")["config"]["eval"]["time_limit_s"])
    except (FileNotFoundError, KeyError, TypeError, ValueError):
        return folders.read_config(run).eval.time_limit_s


def _parse(argv: Sequence[str]) -> SweepArgs:
    """Returns the flags; raises UsageError for a grid that is too large or has unused flags."""
    args = options.parse("sweep", SweepArgs, argv, DESCRIPTION)
    benchmark_args.check(args, SweepArgs(), "trocars", "radii_cm")
    count = len(args.radii_cm) * len(args.polars_deg) * args.azimuths
    checks.expect(count <= MAX_TROCARS, "azimuths", f"at most {MAX_TROCARS} grid points", count)
    is_grid, default = bool(args.radii_cm), SweepArgs()
    for field in ("trocars",) if is_grid else ("polars_deg", "azimuths"):
        value = getattr(args, field)
        expected = "no value with --radii-cm" if is_grid else "--radii-cm with it"
        checks.expect(value == getattr(default, field), field, expected, value)
    return args


def _folder(path: policy_args.PolicyPath) -> Path:
    """Returns the directory of sweep.json."""
    return path.run if path.run and not path.arms else path.folder("sweep", [])


def _trials(folder: Path, args: SweepArgs) -> Path:
    """Returns the directory of a sweep's trials; each sweep has its own."""
    settings = dataclasses.asdict(args)
    # The chunks' size does not change results; file and arms are those of `folder`, and the
    # benchmark's trials are among the rest.
    for name in ("run", "policy", "arm", "benchmark"):
        del settings[name]
    del settings["eval"]["chunk"]
    digest = hashlib.sha256(json.dumps(settings).encode()).hexdigest()
    return folder / "sweep" / f"seed{args.seed}-{digest[:8]}"


def _trocars(args: SweepArgs, task: "Task") -> Any:
    """Returns the sample or the grid of trocars."""
    import numpy as np

    from starjax.evaluation import sweep

    if not args.radii_cm:
        return sweep.sample(args.seed, args.trocars, task)
    # All arms of a grid point would have the same trocar.
    checks.expect(task.arms == 1, "radii_cm", "no grid with several arms", args.radii_cm)
    azimuths = 2 * np.pi * np.arange(args.azimuths) / args.azimuths
    radii = np.array(args.radii_cm) / 100
    return sweep.grid(radii, np.deg2rad(args.polars_deg), azimuths, task.arms)


def _outcome(figures: dict[str, Any]) -> str:
    """Returns a table of success by distance to the nearest training trocar."""
    lines = ["", "  distance to the nearest training trocar   success"]
    for row in figures["by_distance"]:
        span = f"{1e3 * row['low_m']:.0f} to {1e3 * row['high_m']:.0f} mm"
        lines.append(f"  {span:40}  {row['successes']}/{row['trials']} = {100 * row['rate']:.0f}%")
    return "\n".join(lines)
