"""`starjax sweep RUN`: a trained policy over any sample or grid of trocars."""

import dataclasses
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from starjax import config as config_lib
from starjax.commands import checks, folders, messages, options, policy_args
from starjax.limits import CountOrZero, Range
from starjax.runtime import files, xla

DESCRIPTION = """Scores a trained policy on a random sample (Eq. 19) or a grid of trocars.

RUN is a method's folder, such as runs/cpu/stardiff; or --policy names a policy.safetensors, from
anywhere, or a policy that ships with starjax. sweep.json, of the last sweep, is in RUN, and with
--arm or --policy in a folder of its own, which the command says. In RUN it is what the report draws
as the success map and as Fig. 4. Trials of every sweep stay beside it, in sweep: the same command
again only puts its figures together."""

# More is a slip of the hand.
MOST_TROCARS = 1_000_000
Several = Annotated[int, Range(1, MOST_TROCARS)]


# The fields of `config.EvalConfig`, with other defaults.
@dataclasses.dataclass(frozen=True, kw_only=True)
class Trials:
    """Closed-loop trials."""

    trials: Several = 1  # trials at each trocar
    # s of simulated time that a trial may take; left out: RUN's, of a file the usual one
    time_limit_s: Annotated[options.FloatOrNone, config_lib.TIME_LIMIT] = None
    chunk: CountOrZero = 0  # trials between two savings, at most; 0: as many as a program runs
    video_trials: CountOrZero = 0  # trials whose joint positions are recorded


@dataclasses.dataclass(frozen=True)
class Options:
    """Flags of the command."""

    run: options.RunOrNone = ""  # a method's folder, such as runs/cpu/stardiff
    # a policy.safetensors, or the name of a policy that ships with starjax, instead of RUN
    policy: str = ""
    arm: tuple[str, ...] = ()  # robots to score it with; left out: those it was trained with
    trocars: Several = 200  # how many to draw; not used with a grid
    # distances of a grid from the nominal trocar in cm, 0 is one point; left out: no grid
    radii_cm: Annotated[tuple[float, ...], Range(0.0, 10.0)] = ()
    # angles of a grid from straight up, in degrees
    polars_deg: Annotated[tuple[float, ...], Range(0.0, 180.0)] = (90.0,)
    azimuths: Several = 12  # how many directions of a grid, evenly around
    seed: config_lib.Seed = 0  # of the sample and of the trials
    eval: Trials = dataclasses.field(default_factory=Trials)


def main(argv: Sequence[str]) -> int:
    """Runs the trials that are missing and writes sweep.json."""
    chosen = _parse(argv)
    # A mistake should not wait for jax.
    _check(chosen)
    named = policy_args.resolve(chosen.run, chosen.policy)
    if chosen.eval.time_limit_s is None:
        limit = dataclasses.replace(chosen.eval, time_limit_s=_time_limit_s(named.run))
        chosen = dataclasses.replace(chosen, eval=limit)
    folder = _folder(named, chosen)
    xla.prepare_xla()
    from starjax.runtime import processes

    processes.join()
    xla.require_devices("starjax.commands.policy_evaluation")
    files.require_writable(folder)

    from starjax.commands import policy_evaluation
    from starjax.evaluation import result, sweep
    from starjax.rollouts import trocars

    who, config = policy_args.load(named, chosen.arm)
    task = who.env.task
    drawn = _trocars(chosen, task)
    trials = config_lib.EvalConfig(**vars(chosen.eval))
    table = policy_evaluation.rollouts(_trials(folder, chosen), who, drawn, trials, chosen.seed)
    if not processes.is_first():
        return 0
    seen = trocars.select(task.trocars, slice(config.demos.seen_trocars))
    figures = sweep.compose(table, seen, who.env.p_world_ref, seed=chosen.seed)
    about = {
        "method": who.trained.method,
        "observation": who.trained.policy.observation,
        "command": options.typed("sweep", argv),
        "weights": who.weights,
        "control_hz": who.env.control_hz,
        "seed": chosen.seed,
        "time_limit_s": chosen.eval.time_limit_s,
    }
    result.write(folder / "sweep.json", who.env.names, figures, about)
    print(_outcome(figures))
    then = f"; {messages.hint(folder, who.weights, 'draws')}" if folder == named.run else ""
    print(f"\nresult: {folder / 'sweep.json'}{then}")
    return 0


def _time_limit_s(run: Path | None) -> float:
    """Time limit of the trials.

    That of the run's result, which later commands do not change; before there is one, what was
    typed last; without a run the default.
    """
    if run is None:
        return config_lib.EvalConfig.time_limit_s
    try:
        return float(files.read_json(run / "result.json")["config"]["eval"]["time_limit_s"])
    except (FileNotFoundError, KeyError, TypeError, ValueError):
        return folders.read_config(run).eval.time_limit_s


def _parse(argv: Sequence[str]) -> Options:
    return options.parse(Options, argv, prog="starjax sweep", description=DESCRIPTION)


def _check(chosen: Options) -> None:
    """Raises UsageError for a flag that asks for too much beside others, or would do nothing."""
    count = len(chosen.radii_cm) * len(chosen.polars_deg) * chosen.azimuths
    most = f"at most {MOST_TROCARS} trocars of its grid"
    checks.expect(count <= MOST_TROCARS, "azimuths", most, count)
    is_grid, default = bool(chosen.radii_cm), Options()
    for field in ("trocars",) if is_grid else ("polars_deg", "azimuths"):
        value = getattr(chosen, field)
        what = "nothing with --radii-cm" if is_grid else "--radii-cm beside it"
        checks.expect(value == getattr(default, field), field, what, value)


def _folder(named: policy_args.PolicyPath, chosen: Options) -> Path:
    """Where sweep.json is written."""
    if named.run:
        return named.run / "-".join(["sweep", *chosen.arm]) if chosen.arm else named.run
    return Path("runs/sweep") / "-".join([policy_args.label(named.file), *chosen.arm])


def _trials(folder: Path, chosen: Options) -> Path:
    """Where a sweep's trials are kept, one folder for each so that none replaces another's."""
    what = dataclasses.asdict(chosen)
    del what["run"], what["policy"], what["arm"], what["eval"]["chunk"]
    digest = hashlib.sha256(json.dumps(what).encode()).hexdigest()
    return folder / "sweep" / f"seed{chosen.seed}-{digest[:8]}"


def _trocars(chosen: Options, task: Any) -> Any:
    """The trocars that the flags describe."""
    import numpy as np

    from starjax.evaluation import sweep

    if not chosen.radii_cm:
        return sweep.sample(chosen.seed, chosen.trocars, task)
    one = "none beside several arms, whose trocars would all be in one place"
    checks.expect(task.arms == 1, "radii_cm", one, chosen.radii_cm)
    azimuths = 2 * np.pi * np.arange(chosen.azimuths) / chosen.azimuths
    radii = np.array(chosen.radii_cm) / 100
    return sweep.grid(radii, np.deg2rad(chosen.polars_deg), azimuths, task.arms)


def _outcome(figures: dict[str, Any]) -> str:
    """Success by distance to the nearest training trocar."""
    lines = ["", "  distance to the nearest training trocar   success"]
    for row in figures["by_distance"]:
        span = f"{1e3 * row['low_m']:.0f} to {1e3 * row['high_m']:.0f} mm"
        lines.append(f"  {span:40}  {row['successes']}/{row['trials']} = {100 * row['rate']:.0f}%")
    return "\n".join(lines)
