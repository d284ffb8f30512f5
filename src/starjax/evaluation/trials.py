"""Finished trials as columns, one row a trial: what is stored, counted and reported."""

from typing import Any, NamedTuple

import numpy as np

SAFE_RCM_M = 2e-3  # a success is safe if the executed RCM error never exceeded this
BY_STEP = ("rcm_error_mm", "rcm_within_mm")  # columns with a row a control step


class Table(NamedTuple):
    """M trials, in order of trocar and trial.

    Attributes:
      trocar: `[M]` int32, index of the trocar; radius `[M]` m, polar and azimuth `[M]` rad.
      trial: `[M]` int32, number within the trocar.
      success: `[M]` bool, strict. An invalid (diverged) trial is none.
      loose: `[M]` bool, SurRoL's test.
      safe: `[M]` bool, strict, and the executed RCM error never above `SAFE_RCM_M`, at no physics
        step.
      invalid, collided: `[M]` bool.
      steps: `[M]` int32, control steps taken; those of the time limit if it ran out.
      source, target: `[M]` int32, pegs.
      rcm_commanded_max: `[M]` m, largest RCM error of a command that was executed.
      rcm_mean, rcm_max: `[M]` m, executed RCM error at the ends of the trial's control steps.
      rcm_within_max: `[M]` m, the largest at any physics step.
      rcm_error_mm: `[sum(steps)]` float16 mm, executed, at the ends of all steps, trial by trial.
      rcm_within_mm: the same, the largest within each step.
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
    steps: np.ndarray
    source: np.ndarray
    target: np.ndarray
    rcm_commanded_max: np.ndarray
    rcm_mean: np.ndarray
    rcm_max: np.ndarray
    rcm_within_max: np.ndarray
    rcm_error_mm: np.ndarray
    rcm_within_mm: np.ndarray


def from_rollouts(rollouts: Any, index: np.ndarray, trial: np.ndarray) -> Table:
    """Columns of the first trials of a batch.

    Args:
      rollouts: `rollout.Rollouts` of at least as many trials.
      index: `[M]` indices of their trocars.
      trial: `[M]`.
    """
    count = len(index)
    env = rollouts.env
    length = rollouts.length[:count]
    steps = rollouts.steps
    errors = [steps.rcm_error[:n, lane] for lane, n in enumerate(length)]
    within = [steps.rcm_error_within[:n, lane] for lane, n in enumerate(length)]
    farthest = _largest(within)
    invalid = env.invalid[:count]
    success = env.success[:count] & ~invalid
    return Table(
        trocar=np.asarray(index, np.int32),
        radius=np.asarray(env.trocar.radius[:count], np.float32),
        polar=np.asarray(env.trocar.polar[:count], np.float32),
        azimuth=np.asarray(env.trocar.azimuth[:count], np.float32),
        trial=np.asarray(trial, np.int32),
        success=success,
        loose=env.loose[:count] & ~invalid,
        safe=success & (farthest <= SAFE_RCM_M),
        invalid=invalid,
        collided=env.collided[:count],
        steps=length,
        source=env.source[:count],
        target=env.target[:count],
        rcm_commanded_max=rollouts.commanded_max[:count],
        rcm_mean=np.array([e.mean() if e.size else 0.0 for e in errors], np.float32),
        rcm_max=_largest(errors),
        rcm_within_max=farthest,
        rcm_error_mm=_joined_mm(errors),
        rcm_within_mm=_joined_mm(within),
    )


def join(tables: list[Table]) -> Table:
    """One table after another."""
    return Table(*(np.concatenate(columns) for columns in zip(*tables, strict=True)))


def select(table: Table, rows: np.ndarray) -> Table:
    """The rows where `rows` `[M]` bool holds."""
    steps = np.repeat(rows, table.steps)
    columns = {
        name: column[steps if name in BY_STEP else rows] for name, column in table._asdict().items()
    }
    return Table(**columns)


def _largest(errors: list[np.ndarray]) -> np.ndarray:
    return np.array([e.max(initial=0.0) for e in errors], np.float32)


def _joined_mm(errors: list[np.ndarray]) -> np.ndarray:
    return (1e3 * np.concatenate(errors)).astype(np.float16)
