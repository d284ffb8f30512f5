"""Trials of an evaluation: which of them count as what, grouped, tallied, placed."""

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from starjax import rcm
from starjax.evaluation import sweep
from starjax.evaluation.result import Trial
from starjax.report import stats
from starjax.sim.tasks.base import TaskText


def tally(trials: Iterable[Trial], outcome: Callable[[Trial], bool] | None = None) -> stats.Rate:
    """Counts the trials for which `outcome` holds (strict success unless told otherwise)."""
    held = [(outcome or strict)(trial) for trial in trials]
    return stats.rate(sum(held), len(held))


def rates(
    trials: Iterable[Trial], outcome: Callable[[Trial], bool] | None = None
) -> tuple[stats.Rate | None, stats.Rate | None]:
    """Tallies seen and unseen trocars; None where there was no trial."""
    seen, unseen = split(trials)
    return tally(seen, outcome) if seen else None, tally(unseen, outcome) if unseen else None


def strict(trial: Trial) -> bool:
    """The task is done, in time."""
    return trial.success


def loose(trial: Trial) -> bool:
    """The task's looser test was met."""
    return trial.loose


def safe(trial: Trial) -> bool:
    """Strict success whose executed RCM error stayed within the bound all along."""
    return trial.success and trial.safe


def split(trials: Iterable[Trial]) -> tuple[list[Trial], list[Trial]]:
    """Trials at seen and at unseen trocars."""
    trials = list(trials)
    return [t for t in trials if t.seen], [t for t in trials if not t.seen]


def by_trocar(trials: Iterable[Trial]) -> list[list[Trial]]:
    """Trials grouped by configuration of trocars, in order of its index."""
    groups: dict[int, list[Trial]] = {}
    for trial in trials:
        groups.setdefault(trial.trocar, []).append(trial)
    return [groups[index] for index in sorted(groups)]


def times(trials: Iterable[Trial], control_hz: float) -> list[float]:
    """Seconds of simulated time that each success took."""
    return [trial.steps / control_hz for trial in trials if strict(trial)]


def worst_rcm_mm(trial: Trial) -> float | None:
    """Largest executed RCM error, within control steps too if the result says so."""
    return trial.rcm_max_mm if trial.rcm_within_max_mm is None else trial.rcm_within_max_mm


def place(trial: Trial) -> tuple[str, str, str]:
    """Radius, polar angle and azimuth as text, one after another for several arms."""
    radius = " / ".join(f"{100 * r:.3g}" for r in trial.radius)
    polar, azimuth = (
        " / ".join(f"{np.degrees(x):.4g}°" for x in angles)
        for angles in (trial.polar, trial.azimuth)
    )
    return f"{radius} cm", polar, azimuth


# Of a failed trial, the first that applies; `timeout` is what is left.
SHORT = {
    "invalid": "diverged",
    "collided": "collided",
    "lost": "lost",
    "loose": "not settled",
    "timeout": "out of time",
}


def meanings(words: TaskText) -> dict[str, str]:
    """The classes of `SHORT` in the task's words."""
    return {
        "invalid": "simulation diverged",
        "collided": words.collided,
        "lost": words.lost or "could not succeed any more",
        "loose": words.nearly,
        "timeout": "out of time",
    }


def failure(trial: Trial) -> str:
    """Key of `SHORT` that tells most about a failed trial."""
    return next((key for key in SHORT if getattr(trial, key, False)), "timeout")


def failures(trials: Iterable[Trial]) -> dict[str, int]:
    """How many failed trials fall in each class, classes without any left out."""
    found = [failure(trial) for trial in trials if not strict(trial)]
    return {key: found.count(key) for key in SHORT if key in found}


def distances(trials: Sequence[Trial], reference: Sequence[Trial]) -> np.ndarray:
    """Distance `[N]` in m from each trial's configuration to the nearest of `reference`."""
    return sweep.distance_to_nearest(_trocars(trials), _trocars(reference), np.zeros(3))


def positions(trials: Sequence[Trial]) -> np.ndarray:
    """Trocar positions `[N, A, 3]` in m, each relative to the nominal one of its arm."""
    return np.asarray(rcm.trocar_position(_trocars(trials), np.zeros(3, np.float32)))


def _trocars(trials: Sequence[Trial]) -> rcm.Trocar:
    """Fields `[N, A]`."""
    return rcm.Trocar(
        *(
            np.array([getattr(trial, name) for trial in trials], np.float32)
            for name in rcm.Trocar._fields
        )
    )
