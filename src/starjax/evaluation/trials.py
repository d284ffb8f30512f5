"""Finished trials as columns, one row per trial, which are stored, counted and reported."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from starjax.sim.rollouts.episodes import Episode

SAFE_RCM_M = 2e-3  # a success is safe if the executed RCM error never exceeded this
BY_STEP = ("rcm_error_mm", "rcm_within_mm")  # columns with a row a control step
_LABEL = "labels."  # before a label's name in a file


class Table(NamedTuple):
    """M trials, in order of trocar and trial. RCM errors are the largest of all arms.

    Attributes:
      trocar: `[M]` int32, index of the configuration.
      radius: `[M, A]` m. polar, azimuth: `[M, A]` rad.
      trial: `[M]` int32, number within the configuration.
      success: `[M]` bool, strict. An invalid (diverged) trial fails.
      loose: `[M]` bool, the task's looser test.
      safe: `[M]` bool, strict, and the executed RCM error never above `SAFE_RCM_M`, at no physics
        step.
      invalid, collided, lost: `[M]` bool.
      steps: `[M]` int32, control steps taken; those of the time limit if it ran out.
      stage: `[M]` int32, the task's at the end.
      labels: name -> `[M]` int32.
      rcm_commanded_max: `[M]` m, largest RCM error of a command that was executed.
      rcm_mean, rcm_max: `[M]` m, executed RCM error at the ends of the trial's control steps.
      rcm_within_max: `[M]` m, the largest at any physics step.
      rcm_error_mm: `[sum(steps)]` float16 mm, executed, at the ends of all steps, trial by trial.
      rcm_within_mm: the same, the largest within each step.
      scores: `[M, D, S]` float32 of the runtime monitor's decisions, see `alarms`; None without.
    """

    trocar: np.ndarray
    radius: np.ndarray
    polar: np.ndarray
    azimuth: np.ndarray
    trial: np.ndarray
    success: np.ndarray
    loose: np.ndarray
    safe: np.ndarray
    invalid: np.ndarray
    collided: np.ndarray
    lost: np.ndarray
    steps: np.ndarray
    stage: np.ndarray
    labels: dict[str, np.ndarray]
    rcm_commanded_max: np.ndarray
    rcm_mean: np.ndarray
    rcm_max: np.ndarray
    rcm_within_max: np.ndarray
    rcm_error_mm: np.ndarray
    rcm_within_mm: np.ndarray
    scores: np.ndarray | None = None


def from_episodes(episodes: Sequence[Episode]) -> Table:
    """Returns the table of episodes with the fields of `episodes.SCORE`."""
    outcomes = [episode.outcome for episode in episodes]

    def column(name: str, kind: type) -> np.ndarray:
        return np.array([outcome[name] for outcome in outcomes], kind)

    def errors(name: str) -> list[np.ndarray]:
        return [episode.joined(name).max(axis=-1) for episode in episodes]

    executed, within = errors("rcm_error"), errors("rcm_error_within")
    success, farthest = column("success", bool), _largest(within)
    return Table(
        trocar=column("trocar", np.int32),
        radius=column("radius", np.float32),
        polar=column("polar", np.float32),
        azimuth=column("azimuth", np.float32),
        trial=column("trial", np.int32),
        success=success,
        loose=column("loose", bool),
        safe=success & (farthest <= SAFE_RCM_M),
        invalid=column("invalid", bool),
        collided=column("collided", bool),
        lost=column("lost", bool),
        steps=column("length", np.int32),
        stage=column("stage", np.int32),
        labels={
            name: np.array([outcome["labels"][name] for outcome in outcomes], np.int32)
            for name in outcomes[0]["labels"]
        },
        rcm_commanded_max=_largest(errors("rcm_error_commanded")),
        rcm_mean=np.array([e.mean() if e.size else 0.0 for e in executed], np.float32),
        rcm_max=_largest(executed),
        rcm_within_max=farthest,
        rcm_error_mm=_joined_mm(executed),
        rcm_within_mm=_joined_mm(within),
    )


def names(labels: Sequence[str], has_scores: bool = False) -> list[str]:
    """Returns the names of the `columns` of a table with these labels."""
    absent = {"labels"} if has_scores else {"labels", "scores"}
    return [
        *(name for name in Table._fields if name not in absent),
        *(f"{_LABEL}{name}" for name in labels),
    ]


def columns(table: Table) -> dict[str, np.ndarray]:
    """Returns the arrays of a table by name, one per label."""
    found = {name: column for name, column in table._asdict().items() if column is not None}
    labels = found.pop("labels")
    return found | {f"{_LABEL}{name}": values for name, values in labels.items()}


def from_columns(found: Mapping[str, np.ndarray]) -> Table:
    """Inverts `columns`; ignores other names."""
    labels = {k.removeprefix(_LABEL): v for k, v in found.items() if k.startswith(_LABEL)}
    fields: dict[str, Any] = {name: found.get(name) for name in Table._fields}
    fields["labels"] = labels
    return Table(**fields)


def join(tables: Sequence[Table]) -> Table:
    """Concatenates tables."""
    parts = [columns(table) for table in tables]
    return from_columns({name: np.concatenate([part[name] for part in parts]) for name in parts[0]})


def select(table: Table, rows: np.ndarray) -> Table:
    """Returns the rows where `rows` `[M]` bool is True."""
    steps = np.repeat(rows, table.steps)
    found = columns(table).items()
    return from_columns({name: x[steps if name in BY_STEP else rows] for name, x in found})


def _largest(errors: list[np.ndarray]) -> np.ndarray:
    return np.array([e.max(initial=0.0) for e in errors], np.float32)


def _joined_mm(errors: list[np.ndarray]) -> np.ndarray:
    return (1e3 * np.concatenate(errors)).astype(np.float16)
