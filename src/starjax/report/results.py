"""What a finished run left on disk, read for the report: results, rollouts, loss curves, sweep."""

import collections
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from starjax import config as config_lib
from starjax import methods
from starjax.evaluation import trial_file
from starjax.report import outcomes, stats, structure
from starjax.runtime import files

OURS = "stardiff"  # the method that the others are compared with
_RECORDED = ("trocar", "trial", "length", "p_world_tip", "p_world_trocar")  # of recorded.npz
_NEAR = 1e-5  # of m and rad: machines draw the same trocar with other last bits


class Rollout(NamedTuple):
    """One recorded trial.

    Attributes:
      trial: its entry of result.json.
      p_world_tip: `[T, 3]` measured tip positions in m, one a control step.
      p_world_trocar: `[3]` m.
      qpos: `[T, Q]` generalised coordinates, or None where only the tip was kept.
      target_peg: index of the peg the block belongs on, -1 if unknown.
    """

    trial: outcomes.Trial
    p_world_tip: np.ndarray
    p_world_trocar: np.ndarray
    qpos: np.ndarray | None
    target_peg: int


class Run(NamedTuple):
    """One method's run directory.

    Attributes:
      path: the run directory.
      result: result.json.
      label: name of the method in tables.
      group: its group in Table III.
      rollouts: recorded trials, empty if none were.
      log: the metrics.jsonl of the training of its weights, None if there is none.
      curves: its lines.
      limit_s: how long a trial may take, simulated.
      sweep: trials of a sweep over other trocars, empty if none was made of these weights.
      sweep_limit_s: the same of these.
      bench: bench.json, empty if there is none of these weights: `starjax bench` once wrote into
        result.json.
      others: names of what lies beside result.json and is of other weights.
    """

    path: Path
    result: dict[str, Any]
    label: str
    group: str
    rollouts: list[Rollout]
    log: Path | None
    curves: list[dict[str, Any]]
    limit_s: float
    sweep: list[outcomes.Trial]
    sweep_limit_s: float
    bench: dict[str, Any]
    others: tuple[str, ...]

    @property
    def trials(self) -> list[outcomes.Trial]:
        """The per-trial records of the evaluation."""
        return self.result.get("trials") or []


def observed(runs: Sequence[Run]) -> str:
    """What the policies see, `state` or `image`, for every output's title."""
    return " and ".join(sorted({run.result["observation"] for run in runs}))


def identity(trial: outcomes.Trial) -> tuple[int, int, int]:
    """What two runs have in common where they met the same trial: trocar, number, seed."""
    return int(trial["trocar"]), int(trial["trial"]), int(trial["seed"])


def _same_place(one: outcomes.Trial, other: outcomes.Trial) -> bool:
    """Whether two trials of one identity met the same trocar: sweeps number their own."""
    fields = ("radius", "polar", "azimuth")
    return all(abs(one[field] - other[field]) <= _NEAR for field in fields)


def most_shared(trials: Iterable[outcomes.Trial]) -> tuple[int, int, int]:
    """The trial that most runs met, of these an unseen one, of these the first."""
    trials = list(trials)
    counts = collections.Counter(map(identity, trials))
    return identity(min(trials, key=lambda t: (-counts[identity(t)], t["seen"], identity(t))))


def swept(runs: Iterable[Run]) -> list[Run]:
    """The runs that have a sweep, its trials in the place of those through the twelve trocars."""
    return [
        run._replace(result={**run.result, "trials": run.sweep}, limit_s=run.sweep_limit_s)
        for run in runs
        if run.sweep
    ]


def trials_seed(run: Run) -> int | None:
    """Seed of a run's trials; a result from before it was recorded has one for everything."""
    return run.result.get("seed", (run.result.get("config") or {}).get("seed"))


def differing(runs: Sequence[Run]) -> list[str]:
    """Flags of what decides the weights, but for the seed, that the runs do not agree on."""
    configs = [run.result["config"] for run in runs if run.result.get("config")]
    return config_lib.differing(configs)


def pair(a: Run, b: Run) -> stats.Paired | None:
    """McNemar's test over the trials that both methods ran with the same trocar, seed and limit."""
    if a.limit_s != b.limit_s:
        return None
    ours, theirs = ({identity(t): t for t in run.trials} for run in (a, b))
    both = [(ours[k], theirs[k]) for k in sorted(ours.keys() & theirs.keys())]
    met = [(one, other) for one, other in both if _same_place(one, other)]
    if not met:
        return None
    return stats.mcnemar(*([outcomes.strict(t) for t in side] for side in zip(*met, strict=True)))


def representatives(runs: Sequence[Run]) -> list[Run]:
    """One run of each group, in the runs' order: STAR-Diff itself, else the most successful of
    those that met the trials of the first STAR-Diff, if any did."""
    seed = next((trials_seed(run) for run in runs if run.result["method"] == OURS), None)

    def standing(run: Run) -> tuple[bool, bool, float]:
        is_ours, same_trials = run.result["method"] == OURS, trials_seed(run) == seed
        return is_ours, same_trials, outcomes.tally(run.trials).rate

    groups = [
        [run for run in runs if run.trials and run.group == g] for g in {r.group for r in runs}
    ]
    best = [max(group, key=standing) for group in groups if group]
    return [run for run in runs if any(run is chosen for chosen in best)]


def load(path: Path) -> Run:
    """Reads the run directory `path`, or a result alone; what a stage did not leave is empty."""
    file = path if path.is_file() else path / "result.json"
    if not file.is_file():
        raise ValueError(f"path: expected a run directory with a result.json, got {path}")
    result = trial_file.read(file)
    structure.check(file, result, structure.RESULT)
    if result["method"] not in methods.METHODS:
        raise ValueError(f"{file}: expected a method of Table II, got {result['method']!r}")
    method = methods.METHODS[result["method"]]
    beside = {name: _beside(path / name, result) for name in structure.BESIDE}
    sweep, bench = (found or {} for found in beside.values())
    log, curves = _curves(path, result)
    others = [name for name, found in beside.items() if found is None]
    others += [log.name] if log and not curves else []
    limit_s = (result["config"].get("eval") or {}).get("time_limit_s") or 0.0
    return Run(
        path=path,
        result=result,
        label=method.label,
        group=method.group,
        rollouts=_rollouts(path, result.get("trials") or []),
        log=log,
        curves=curves,
        limit_s=limit_s,
        sweep=sweep.get("trials") or [],
        sweep_limit_s=sweep.get("time_limit_s") or limit_s,
        bench=bench,
        others=tuple(others),
    )


def training_trocars(run: Run) -> list[outcomes.Trial]:
    """One trial of each trocar that the demonstrations used."""
    return [group[0] for group in outcomes.by_trocar(run.trials) if group[0]["seen"]]


def latencies(run: Run) -> list[tuple[int, dict[str, float]]]:
    """(DDIM steps, {p50, p95, p99} in ms) of one policy call, fewest steps first."""
    rows = (run.bench or run.result).get("inference_ms_by_ddim_steps") or {}
    found = {int(n): ms for n, ms in rows.items()}
    if run.result.get("inference_ms"):
        steps = run.result["config"]["policy"]["ddim_steps"]
        found.setdefault(int(steps), run.result["inference_ms"])
    return sorted(found.items())


def _rollouts(path: Path, trials: Sequence[outcomes.Trial]) -> list[Rollout]:
    """Reads evaluation/recorded.npz: one row a recorded trial, cut to its `length`."""
    file = path / "evaluation" / "recorded.npz"
    if not file.is_file():
        return []
    try:
        kept = files.read_npz(file, _RECORDED)
    except ValueError as error:
        raise ValueError(
            f"{error}; remove {path / 'result.json'}, and the same run makes both again"
        ) from error
    rollouts = []
    for row, length in enumerate(kept["length"]):
        if length < 2 or not np.isfinite(kept["p_world_tip"][row, :length]).all():
            continue
        same = (t for t in trials if t["trocar"] == kept["trocar"][row])
        trial = next((t for t in same if t["trial"] == kept["trial"][row]), None)
        if trial is not None and _is_recorded(trial, kept, row):
            rollouts.append(
                Rollout(
                    trial=trial,
                    p_world_tip=kept["p_world_tip"][row, :length],
                    p_world_trocar=kept["p_world_trocar"][row],
                    qpos=kept["qpos"][row, :length] if "qpos" in kept else None,
                    target_peg=int(kept["target_peg"][row]) if "target_peg" in kept else -1,
                )
            )
    return rollouts


def _is_recorded(trial: outcomes.Trial, kept: dict[str, np.ndarray], row: int) -> bool:
    """Whether a recorded trial is this one: after a kill it may be of another evaluation, whose
    seed or weights gave it another length or, if it ran out of time too, other errors."""
    if trial["steps"] != kept["length"][row]:
        return False
    if "rcm_error" not in kept or trial.get("rcm_max_mm") is None:
        return True  # written before they were: not known
    largest = 1e3 * kept["rcm_error"][row, : trial["steps"]].max()
    return bool(np.isclose(largest, trial["rcm_max_mm"], rtol=1e-5, atol=0))


def _beside(file: Path, result: dict[str, Any]) -> dict[str, Any] | None:
    """What another command left beside result.json; None if it is of other weights."""
    if not file.is_file():
        return {}
    found = trial_file.read(file)
    structure.check(file, found, structure.BESIDE[file.name])
    weights = {x["weights"] for x in (found, result) if "weights" in x}  # once neither said it
    return found if len(weights) < 2 else None


def _curves(path: Path, result: dict[str, Any]) -> tuple[Path | None, list[dict[str, Any]]]:
    """The log of a run's training, which another method's folder has where they share weights, and
    its lines; none of them if it is of a training with other settings."""
    method, places = result["method"], [path]
    if path.name == method:
        places.insert(0, path.parent / methods.METHODS[method].weights_of)
    for place in places:
        file = place / "metrics.jsonl"
        if lines := _lines(file):
            return file.resolve(), lines if _is_of(place, result) else []
    return None, []


def _is_of(folder: Path, result: dict[str, Any]) -> bool:
    """Whether a folder's training had the settings of a result, if it says so."""
    if not (folder / "config.json").is_file():
        return True
    try:
        trained, config = files.read_json(folder / "config.json"), result["config"]
        same_seed = trained["seed"] == config.get("seed", trained["seed"])
        return same_seed and not config_lib.differing([trained, config])
    except (AttributeError, KeyError, TypeError, ValueError):
        return True  # damaged, or of another version: not known


def _lines(file: Path) -> list[dict[str, Any]]:
    """What is whole of a log: a kill may have cut its last line short."""
    lines = file.read_bytes().splitlines(keepends=True) if file.is_file() else []
    try:
        found = [json.loads(line) for line in lines if line.endswith(b"\n")]
    except ValueError as error:
        raise ValueError(f"{file} is damaged: {error}") from error
    for number, line in enumerate(found, 1):
        structure.check(file, line, structure.LINE, f"line {number}")
    return found
