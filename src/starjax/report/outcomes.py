"""Trials of an evaluation: which of them count as what, grouped, tallied, placed."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.report import stats

Trial = dict[str, Any]  # one entry of result.json's `trials`

CONTROL_HZ = 30.0  # of the environment; a test holds the two together


def tally(trials: Iterable[Trial], outcome: Callable[[Trial], bool] | None = None) -> stats.Rate:
    """Counts the trials for which `outcome` holds (strict success unless told otherwise)."""
    held = [bool((outcome or strict)(trial)) for trial in trials]
    return stats.rate(sum(held), len(held))


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


def worst_rcm_mm(trial: Trial) -> float | None:
    """Largest executed RCM error, within control steps too if the result says so."""
    return trial.get("rcm_within_max_mm", trial.get("rcm_max_mm"))


def place(trial: Trial) -> tuple[str, str, str]:
    """The trocar's radius, polar angle and azimuth as text."""
    polar, azimuth = np.degrees(trial["polar"]), np.degrees(trial["azimuth"])
    return f"{100 * trial['radius']:.3g} cm", f"{polar:.4g}°", f"{azimuth:.4g}°"


FAILURES = {
    "invalid": "simulation diverged",
    "collided": "touched board, peg or block with shaft or arm",
    "loose": "block at its peg, but not threaded, released and at rest",
    "timeout": "out of time",
}


SHORT = {
    "invalid": "diverged",
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


def distances(trials: Sequence[Trial], reference: Sequence[Trial]) -> np.ndarray:
    """Distance in m, `[len(trials)]`, from each trial's trocar to the nearest of `reference`."""
    apart = positions(trials)[:, None] - positions(reference)[None]
    return np.linalg.norm(apart, axis=-1).min(axis=1)


def positions(trials: Sequence[Trial]) -> np.ndarray:
    """Trocar positions `[len(trials), 3]` in m relative to the nominal port."""
    fields = np.array([[t["radius"], t["polar"], t["azimuth"]] for t in trials], np.float32).T
    return np.asarray(rcm.trocar_position(rcm.Trocar(*fields), jnp.zeros(3)))
