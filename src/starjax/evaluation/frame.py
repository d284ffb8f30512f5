"""Trials of results as one table, a row per trial, for pandas or a CSV file.

Angles are in degrees, rounded to 1e-4; results store radians. Columns, in order:

    run, method, label, task, observation   folder, policy and scene of the result
    train_seed, seed                         of the training (None if unknown) and of the trials
    trocar, trial, seen                      identity of the trial
    success, loose, safe                     the three tests, success is the strict one
    invalid, collided, lost                  causes of failures
    steps, seconds, stage                    simulated duration and last stage
    radius_mm, polar_deg, azimuth_deg        place of the trocar; `_0`, `_1` appended for two arms
    rcm_max_mm, rcm_within_max_mm, rcm_commanded_max_mm
    distance_mm                              in sweeps, to the nearest trocar of the training
    <name>                                   each label of the task, such as source and target
"""

import importlib
import importlib.util
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from starjax.core import errors, methods
from starjax.evaluation import locate, result
from starjax.evaluation.content import Trial

_PLAIN = (
    *("seed", "trocar", "trial", "seen", "success", "loose", "safe"),
    *("invalid", "collided", "lost", "steps"),
)
_ERRORS = ("rcm_max_mm", "rcm_within_max_mm", "rcm_commanded_max_mm")
# Field of a trial -> column and its unit as a factor.
_PLACE = {
    "radius": ("radius_mm", 1e3),
    "polar": ("polar_deg", math.degrees(1)),
    "azimuth": ("azimuth_deg", math.degrees(1)),
}


def results(paths: str | Path | Iterable[str | Path]) -> Any:
    """Reads results into a `pandas.DataFrame` with a row per trial; see the module's columns.

    Args:
      paths: one or several result.json, sweep.json, folders with one, or their parents.

    Raises:
      errors.UsageError: pandas is not installed, or a path has no result.
      ValueError: a file is damaged; the message names it.
    """
    if importlib.util.find_spec("pandas") is None:
        hint = "pip install pandas, or take starjax.evaluation.frame.rows"
        raise errors.UsageError("results", "pandas to be installed", "no such package", hint)
    return importlib.import_module("pandas").DataFrame(rows(paths))


def rows(paths: str | Path | Iterable[str | Path]) -> list[dict[str, Any]]:
    """Reads results into dicts, one per trial, with equal keys; raises as `results`."""
    files = [file for path in _several(paths) for file in locate.results("paths", path)]
    table = [row for file in dict.fromkeys(files) for row in _rows(file)]
    names = dict.fromkeys(name for row in table for name in row)
    return [{name: row.get(name) for name in names} for row in table]


def _several(paths: str | Path | Iterable[str | Path]) -> list[str | Path]:
    return [paths] if isinstance(paths, str | Path) else list(paths)


def _rows(file: Path) -> list[dict[str, Any]]:
    read = result.read_sweep if file.name == locate.SWEEP else result.read
    scored = read(file)
    about = {
        "run": str(file.parent),
        "method": scored.method,
        "label": methods.SCORED[scored.method].label if scored.method in methods.SCORED else "",
        "task": scored.scene.task,
        "observation": scored.observation,
        "train_seed": scored.config.get("seed"),
    }
    return [about | _row(trial, scored.control_hz) for trial in scored.trials]


def _row(trial: Trial, hz: float) -> dict[str, Any]:
    row = {name: getattr(trial, name) for name in _PLAIN}
    row |= {"seconds": trial.steps / hz, "stage": trial.stage}
    for field, (column, factor) in _PLACE.items():
        values = getattr(trial, field)
        for arm, value in enumerate(values):
            end = f"_{arm}" if len(values) > 1 else ""
            row[f"{column}{end}"] = round(factor * value, 4)
    row |= {name: getattr(trial, name) for name in _ERRORS}
    row["distance_mm"] = None if trial.distance_m is None else 1e3 * trial.distance_m
    return row | trial.labels
