"""Outcomes of trials: classes, groups, tallies and positions."""

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from starjax import rcm
from starjax.evaluation import sweep
from starjax.evaluation.result import Trial
from starjax.report import stats
from starjax.sim.task import TaskText


def tally(trials: Iterable[Trial], outcome: Callable[[Trial], bool] | None = None) -> stats.Rate:
    """Counts the trials for which `outcome` holds, by default strict success."""
    held = [(outcome or strict)(trial) for trial in trials]
    return stats.rate(sum(held), len(held))


def rates(
    trials: Iterable[Trial], outcome: Callable[[Trial], bool] | None = None
) -> tuple[stats.Rate | None, stats.Rate | None]:
    """Tallies trials at seen and at unseen trocars; None without trials."""
    seen, unseen = split(trials)
    return tally(seen, outcome) if seen else None, tally(unseen, outcome) if unseen else None


def strict(trial: Trial) -> bool:
    """Returns True for strict success: the task was done in time."""
    return trial.success


def loose(trial: Trial) -> bool:
    """Returns True if the task's looser test was met."""
    return trial.loose


def safe(trial: Trial) -> bool:
    """Returns True for strict success with the executed RCM error always within its bound."""
    return trial.success and trial.safe


def split(trials: Iterable[Trial]) -> tuple[list[Trial], list[Trial]]:
    """Splits trials into those at seen and at unseen trocars."""
    trials = list(trials)
    return [t for t in trials if t.seen], [t for t in trials if not t.seen]


def by_trocar(trials: Iterable[Trial]) -> list[list[Trial]]:
    """Groups trials by trocar configuration, in order of its index."""
    groups: dict[int, list[Trial]] = {}
    for trial in trials:
        groups.setdefault(trial.trocar, []).append(trial)
    return [groups[index] for index in sorted(groups)]


def times(trials: Iterable[Trial], control_hz: float) -> list[float]:
    """Returns the simulated seconds of each success."""
    return [trial.steps / control_hz for trial in trials if strict(trial)]


def worst_rcm_mm(trial: Trial) -> float | None:
    """Returns the largest executed RCM error, within control steps too if recorded."""
    return trial.rcm_max_mm if trial.rcm_within_max_mm is None else trial.rcm_within_max_mm


def place(trial: Trial) -> tuple[str, str, str]:
    """Renders radius, polar angle and azimuth, with a value per arm."""
    radius = " / ".join(f"{100 * r:.3g}" for r in trial.radius)
    polar, azimuth = (
        " / ".join(f"{np.degrees(x):.4g}°" for x in angles)
        for angles in (trial.polar, trial.azimuth)
    )
    return f"{radius} cm", polar, azimuth


# Classes of failures: the first that applies counts; `timeout` is the rest.
SHORT = {
    "invalid": "diverged",
    "collided": "collided",
    "lost": "lost",
    "loose": "not settled",
    "timeout": "out of time",
}


def meanings(text: TaskText) -> dict[str, str]:
    """Describes the classes of `SHORT` for a task."""
    return {
        "invalid": "simulation diverged",
        "collided": text.collided,
        "lost": text.lost or "could not succeed any more",
        "loose": text.nearly,
        "timeout": "out of time",
    }


def failure(trial: Trial) -> str:
    """Returns the class of a failed trial, a key of `SHORT`."""
    return next((key for key in SHORT if getattr(trial, key, False)), "timeout")


def failures(trials: Iterable[Trial]) -> dict[str, int]:
    """Counts failed trials per class; empty classes are omitted."""
    classes = [failure(trial) for trial in trials if not strict(trial)]
    return {key: classes.count(key) for key in SHORT if key in classes}


def distances(trials: Sequence[Trial], reference: Sequence[Trial]) -> np.ndarray:
    """Returns distances `[N]` in m from each trial's trocars to the nearest of `reference`."""
    return sweep.distance_to_nearest(_trocars(trials), _trocars(reference), np.zeros(3))


def positions(trials: Sequence[Trial]) -> np.ndarray:
    """Returns trocar positions `[N, A, 3]` in m, relative to the nominal one of each arm."""
    return np.asarray(rcm.trocar_position(_trocars(trials), np.zeros(3, np.float32)))


def _trocars(trials: Sequence[Trial]) -> rcm.Trocar:
    """Stacks the trials' trocars; fields `[N, A]`."""
    return rcm.Trocar(
        *(
            np.array([getattr(trial, name) for trial in trials], np.float32)
            for name in rcm.Trocar._fields
        )
    )
