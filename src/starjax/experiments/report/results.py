"""What a finished run left on disk, read for the report: results, rollouts, loss curves, sweep."""

import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from starjax import rcm
from starjax.experiments import methods
from starjax.experiments.report import stats

OURS = "stardiff"  # the method that the others are compared with
CONTROL_HZ = 30.0  # of the environment; a test holds the two together
Trial = dict[str, Any]  # one entry of result.json's `trials`


class Rollout(NamedTuple):
    """One recorded trial.

    Attributes:
      trial: its entry of result.json.
      p_world_tip: `[T, 3]` measured tip positions in m, one a control step.
      p_world_trocar: `[3]` m.
      qpos: `[T, Q]` generalised coordinates, or None where only the tip was kept.
      target_peg: index of the peg the block belongs on, -1 if unknown.
    """

    trial: Trial
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
      curves: lines of metrics.jsonl.
      sweep: trials of a sweep over other trocars, empty if none was made.
    """

    path: Path
    result: dict[str, Any]
    label: str
    group: str
    rollouts: list[Rollout]
    curves: list[dict[str, Any]]
    sweep: list[Trial]

    @property
    def trials(self) -> list[Trial]:
        """The per-trial records of the evaluation."""
        return self.result.get("trials") or []


def tally(trials: Iterable[Trial], outcome: Callable[[Trial], bool] | None = None) -> stats.Rate:
    """Counts the trials for which `outcome` holds (strict success unless told otherwise)."""
    held = [bool((outcome or strict)(trial)) for trial in trials]
    return stats.wilson(sum(held), len(held))


def strict(trial: Trial) -> bool:
    """Threaded on the target peg, released, at rest, in time."""
    return bool(trial["success"])


def loose(trial: Trial) -> bool:
    """SurRoL's test."""
    return bool(trial["loose"])


def safe(trial: Trial) -> bool:
    """Strict success whose executed RCM error stayed within the bound all along."""
    return bool(trial["success"] and trial["safe"])


def split(trials: Iterable[Trial]) -> tuple[list[Trial], list[Trial]]:
    """Trials at seen and at unseen trocars."""
    trials = list(trials)
    return [t for t in trials if t["seen"]], [t for t in trials if not t["seen"]]


def by_trocar(trials: Iterable[Trial]) -> list[list[Trial]]:
    """Trials grouped by trocar, in order of the trocar's index."""
    groups: dict[int, list[Trial]] = {}
    for trial in trials:
        groups.setdefault(int(trial["trocar"]), []).append(trial)
    return [groups[index] for index in sorted(groups)]


def transfer_times(trials: Iterable[Trial]) -> list[float]:
    """Seconds of simulated time that each success took."""
    return [trial["steps"] / CONTROL_HZ for trial in trials if strict(trial)]


def place(trial: Trial) -> tuple[str, str, str]:
    """The trocar's radius, polar angle and azimuth as text."""
    polar, azimuth = np.degrees(trial["polar"]), np.degrees(trial["azimuth"])
    return f"{100 * trial['radius']:.3g} cm", f"{polar:.4g}°", f"{azimuth:.4g}°"


FAILURES = {
    "invalid": "simulation diverged",
    "dropped": "block dropped",
    "collided": "touched board, peg or block with shaft or arm",
    "loose": "block at its peg, but not threaded, released and at rest",
    "timeout": "out of time",
}


SHORT = {
    "invalid": "diverged",
    "dropped": "dropped",
    "collided": "collided",
    "loose": "not settled",
    "timeout": "out of time",
}


def failure(trial: Trial) -> str:
    """Key of `FAILURES` that tells most about a failed trial: the first that applies."""
    return next((key for key in FAILURES if trial.get(key)), "timeout")


def failures(trials: Iterable[Trial]) -> dict[str, int]:
    """How many failed trials fall in each class, classes without any left out."""
    found = [failure(trial) for trial in trials if not strict(trial)]
    return {key: found.count(key) for key in FAILURES if key in found}


def pair(a: Run, b: Run) -> stats.Paired | None:
    """McNemar's test over the trials that both methods ran with the same trocar and seed."""

    def key(trial: Trial) -> tuple[int, int, int]:
        return int(trial["trocar"]), int(trial["trial"]), int(trial["seed"])

    ours, theirs = ({key(t): strict(t) for t in run.trials} for run in (a, b))
    common = sorted(ours.keys() & theirs.keys())
    if not common:
        return None
    return stats.mcnemar([ours[k] for k in common], [theirs[k] for k in common])


def representatives(runs: Sequence[Run]) -> list[Run]:
    """One run of each group, in the runs' order: STAR-Diff itself, else the most successful."""

    def standing(run: Run) -> tuple[bool, float]:
        return run.result["method"] == OURS, tally(run.trials).rate

    groups = [
        [run for run in runs if run.trials and run.group == g] for g in {r.group for r in runs}
    ]
    best = [max(group, key=standing) for group in groups if group]
    return [run for run in runs if any(run is chosen for chosen in best)]


def distances(trials: Sequence[Trial], reference: Sequence[Trial]) -> np.ndarray:
    """Distance in m, `[len(trials)]`, from each trial's trocar to the nearest of `reference`."""
    apart = positions(trials)[:, None] - positions(reference)[None]
    return np.linalg.norm(apart, axis=-1).min(axis=1)


def positions(trials: Sequence[Trial]) -> np.ndarray:
    """Trocar positions `[len(trials), 3]` in m relative to the nominal port."""
    fields = np.array([[t["radius"], t["polar"], t["azimuth"]] for t in trials], np.float32).T
    return np.asarray(rcm.trocar_position(rcm.Trocar(*fields), np.zeros(3, np.float32)))


def load(path: Path) -> Run:
    """Reads the run directory `path`; what a stage did not leave behind is empty."""
    file = path / "result.json"
    if not file.is_file():
        raise ValueError(f"path: expected a run directory with a result.json, got {path}")
    result = json.loads(file.read_text())
    method = methods.METHODS[result["method"]]
    return Run(
        path=path,
        result=result,
        label=method.label,
        group=method.group,
        rollouts=_rollouts(path, result.get("trials") or []),
        curves=_lines(path / "metrics.jsonl"),
        sweep=_sweep(path / "sweep.json"),
    )


def training_trocars(run: Run) -> list[Trial]:
    """One trial of each trocar that the demonstrations used."""
    return [group[0] for group in by_trocar(run.trials) if group[0]["seen"]]


def latencies(run: Run) -> list[tuple[int, dict[str, float]]]:
    """(DDIM steps, {p50, p95, p99} in ms) of one policy call, fewest steps first."""
    found = {int(n): ms for n, ms in (run.result.get("inference_ms_by_ddim_steps") or {}).items()}
    if run.result.get("inference_ms"):
        steps = run.result["config"]["policy"]["ddim_steps"]
        found.setdefault(int(steps), run.result["inference_ms"])
    return sorted(found.items())


def _rollouts(path: Path, trials: Sequence[Trial]) -> list[Rollout]:
    """Reads evaluation/recorded.npz: one row a recorded trial, cut to its `length`."""
    file = path / "evaluation" / "recorded.npz"
    if not file.is_file():
        return []
    with np.load(file, allow_pickle=False) as arrays:
        kept = dict(arrays)
    rollouts = []
    for row, length in enumerate(kept["length"]):
        if length < 2 or not np.isfinite(kept["p_world_tip"][row, :length]).all():
            continue
        same = (t for t in trials if t["trocar"] == kept["trocar"][row])
        trial = next((t for t in same if t["trial"] == kept["trial"][row]), None)
        if trial is not None:
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


def _sweep(file: Path) -> list[Trial]:
    return json.loads(file.read_text())["trials"] if file.is_file() else []


def _lines(file: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in file.read_text().splitlines()] if file.is_file() else []
