"""Finished runs as the report reads them: results, trajectories, loss curves, sweeps."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from starjax.core import errors, methods
from starjax.core.types import Pose
from starjax.evaluation import recorded
from starjax.evaluation.result import Result, Trial, read
from starjax.report import outcomes, sidecars


class TrialTrajectory(NamedTuple):
    """One recorded trial of T control steps.

    Attributes:
      trial: entry of result.json.
      p_world_tip: `[T, A, 3]` measured tip positions in m.
      p_world_trocar: `[A, 3]` m.
      qpos: `[T, Q]` generalised coordinates, or None if only the tips were recorded.
      labels: the task's labels, which mark the goal.
      endoscope: pose_world_camera `[T]`, or None without an endoscope.
    """

    trial: Trial
    p_world_tip: np.ndarray
    p_world_trocar: np.ndarray
    qpos: np.ndarray | None
    labels: dict[str, int]
    endoscope: Pose | None = None


class Run(NamedTuple):
    """One method's run directory.

    Attributes:
      path: the run directory, or the file of a single result.
      result: result.json.
      label: name of the method in tables.
      group: its group in Table III.
      rollouts: recorded trials, empty if none were.
      log: metrics.jsonl of its training, or None.
      curves: lines of the log.
      sweep: trials through other trocars with these weights, or None.
      stress: stress.json of these weights, or empty.
      bench: bench.json of these weights, or empty.
      others: names of files next to result.json that belong to other weights.
    """

    path: Path
    result: Result
    label: str
    group: str
    rollouts: list[TrialTrajectory]
    log: Path | None
    curves: list[dict[str, Any]]
    sweep: Result | None
    stress: dict[str, Any]
    bench: dict[str, Any]
    others: tuple[str, ...]

    @property
    def trials(self) -> tuple[Trial, ...]:
        """The trials of the evaluation."""
        return self.result.trials

    @property
    def limit_s(self) -> float:
        """Time limit of a trial in simulated s."""
        return self.result.time_limit_s

    @property
    def rcm_error_mm(self) -> dict[str, Any]:
        """Kind (commanded, executed, within_steps) -> figures; empty if not recorded."""
        return self.result.figures.get("rcm_error_mm") or {}


def load(path: Path) -> Run:
    """Reads the run directory `path`, or a single result; missing files leave empty fields.

    Raises:
      ValueError: there is no result, a file is damaged, or the method is unknown.
    """
    file = path if path.is_file() else path / "result.json"
    if not file.is_file():
        raise errors.UsageError("path", "a run directory with a result.json", path)
    result = read(file)
    if result.method not in methods.SCORED:
        raise errors.UsageError(f"{file}: method", "one of starjax list", repr(result.method))
    method = methods.SCORED[result.method]
    swept, bench = sidecars.sweep(path), sidecars.bench(path)
    log, curves = sidecars.curves(path, result)
    weights = {"sweep.json": swept.weights if swept else None, "bench.json": bench.get("weights")}
    others = [name for name, of in weights.items() if _are_others(of, result.weights)]
    return Run(
        path=path,
        result=result,
        label=method.label,
        group=method.group,
        rollouts=_rollouts(path, result.trials),
        log=log,
        curves=curves,
        sweep=None if "sweep.json" in others else swept,
        stress=sidecars.stress(path, result.weights),
        bench={} if "bench.json" in others else bench,
        others=(*others, log.name) if log and not curves else tuple(others),
    )


def swept(runs: Iterable[Run]) -> list[Run]:
    """Returns the runs that have a sweep, with the sweep's trials as theirs."""
    return [
        run._replace(
            result=run.result._replace(
                trials=run.sweep.trials, time_limit_s=sweep_limit_s(run), about=run.sweep.about
            )
        )
        for run in runs
        if run.sweep
    ]


def jax_settings(run: Run) -> dict[str, str]:
    """Returns the settings of jax that differed from the defaults in a run's trials."""
    return run.result.about.get("jax_settings") or {}


def sweep_limit_s(run: Run) -> float:
    """Returns the time limit of the sweep's trials, by default that of the run's."""
    return (run.sweep.time_limit_s if run.sweep else 0.0) or run.limit_s


def trained_seed(run: Run) -> int | None:
    """Returns the seed of the training, None if unknown."""
    return run.result.config.get("seed")


def training_trocars(run: Run) -> list[Trial]:
    """Returns one trial of each trocar configuration in the demonstrations."""
    return [group[0] for group in outcomes.by_trocar(run.trials) if group[0].seen]


def latencies(run: Run) -> list[tuple[int, dict[str, float]]]:
    """Returns (DDIM steps, {p50, p95, p99} in ms) of one policy call, fewest steps first."""
    about = run.result.about
    rows = (run.bench or about).get("inference_ms_by_ddim_steps") or {}
    by_steps = {int(n): ms for n, ms in rows.items()}
    steps = run.result.config.get("policy", {}).get("ddim_steps")
    if steps and about.get("inference_ms"):
        by_steps.setdefault(int(steps), about["inference_ms"])
    return sorted(by_steps.items())


def _are_others(digest: str | None, weights: str | None) -> bool:
    """Returns True if a file belongs to other weights; old files lack the digest."""
    return None not in (digest, weights) and digest != weights


def _rollouts(path: Path, trials: Sequence[Trial]) -> list[TrialTrajectory]:
    """Reads the recorded trajectories of `trials`."""
    file = path / "evaluation" / "recorded.npz"
    if not file.is_file():
        return []
    try:
        kept = recorded.read(file)
    except ValueError as error:
        raise ValueError(
            f"{error}; remove {path / 'result.json'}, and the same run makes both again"
        ) from error
    known = {(trial.trocar, trial.trial): trial for trial in trials}
    return [
        TrialTrajectory(trial, *(getattr(track, name) for name in TrialTrajectory._fields[1:]))
        for track in kept
        if (trial := known.get((track.trocar, track.trial))) and _is_recorded(trial, track)
    ]


def _is_recorded(trial: Trial, track: recorded.Trajectory) -> bool:
    """Returns True if a trajectory is complete and belongs to a trial.

    After a kill it may belong to another evaluation, whose seed or weights changed its length or,
    if both ran out of time, its errors.
    """
    length = len(track.p_world_tip)
    if length < 2 or length != trial.steps or not np.isfinite(track.p_world_tip).all():
        return False
    if track.rcm_error is None or trial.rcm_max_mm is None:
        return False
    return bool(np.isclose(1e3 * track.rcm_error.max(), trial.rcm_max_mm, rtol=1e-5, atol=0))
