"""Plans, tips and jaws of a policy's trials at every decision: the material of a monitor's scores.

    python benchmarks/monitor_traces.py POLICY OUT.npz SAMPLED EACH [NAME=LEVEL ...]

Runs undisturbed trials with SAMPLED trocars, as `starjax calibrate` does, and EACH trials at every
trocar of the task, undisturbed and under each disturbance. Scores can then be designed without a
GPU: `read` returns the numbers of every decision. They are stored as int16 in steps of 0.1 mm and
0.0001, those of a long failure to 16 s.
"""

import functools
import sys
from pathlib import Path
from typing import Any
from unittest import mock

import monitor_trials
import numpy as np

from starjax.evaluation import alarms, disturbances, sweep
from starjax.policies.monitor.scores import ScoreSettings
from starjax.runtime import files, xla
from starjax.sim.rollouts import plans

COLUMNS = ("success", "lost", "invalid", "steps", "stage", "trocar")
EVERY, TIPS = 2, 2  # planned points that are kept, one of so many; measured tips of a decision
FAILED_S = 16.0  # longer than any calibrated clock
STEP = 1e-4  # m, and of openings in [-1, 1]
_COMMANDED = "commanded_gripper"


def main(policy: str, out: str, sampled: str, each: str, *levels: str) -> None:
    """Runs the trials and writes their decisions."""
    xla.prepare_xla()
    kinds = disturbances.parse_levels("disturbance", levels)
    who = monitor_trials.disturbable(policy, kinds)
    execute, task = who.trained.policy.execute, who.env.task
    settings = ScoreSettings(execute, who.env.control_hz, 1)
    of = monitor_trials.Trials
    sets = {"sampled": of(sweep.sample(1, int(sampled), task), 1, 1, {})}
    sets["nothing"] = of(task.trocars, int(each), 0, {})
    for name, level in kinds.items():
        sets[f"{name}={level:g}"] = of(task.trocars, int(each), 0, {name: level})
    arrays: dict[str, np.ndarray] = {"execute": np.array(execute)}
    with (
        mock.patch.object(plans, "record", functools.partial(_record, plans.record)),
        mock.patch.object(alarms, "of_episodes", _decisions),
    ):
        folder = Path(out).with_suffix("")
        for label, table in monitor_trials.evaluations(folder, who, settings, sets):
            arrays |= {f"{label}/{name}": x for name, x in _stored(table, settings).items()}
    files.write_npz(Path(out), arrays)


def read(file: str, label: str) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Returns the columns of a set of trials and its decisions `[M, D, A, K]`, NaN after their end.

    K: planned points (x, y, z), measured tips (x, y, z), all in m, measured and commanded opening.
    """
    with np.load(file) as arrays:
        columns = {name: arrays[f"{label}/{name}"] for name in COLUMNS}
        lengths, packed = arrays[f"{label}/lengths"], arrays[f"{label}/decisions"]
    rows = np.moveaxis(packed.astype(float), -1, 0) * STEP  # [R, A, K]
    points = rows[..., :-2].reshape(*rows.shape[:2], -1, 3).cumsum(axis=-2)
    rows = np.concatenate([points.reshape(*rows.shape[:2], -1), rows[..., -2:]], axis=-1)
    whole = np.full((len(lengths), lengths.max(), *rows.shape[1:]), np.nan)
    whole[np.arange(lengths.max()) < lengths[:, None]] = rows
    return columns, whole


def _record(record: Any, execute: int) -> Any:
    """Returns `plans.record` with the jaws' commanded openings."""
    made = record(execute)

    def fields(step: Any) -> dict[str, Any]:
        return {**made.fields(step), _COMMANDED: step.executed.gripper}

    return made._replace(fields=fields)


def _decisions(episodes: Any, settings: ScoreSettings, max_steps: int) -> np.ndarray:
    """Returns `[M, D, A * K]` float32 in place of `alarms.of_episodes`."""
    execute = settings.execute
    trials = []
    for episode in episodes:
        joined = map(episode.joined, (plans.PLANNED, plans.AHEAD, plans.MEASURED, plans.OPENING))
        planned, ahead, tip, opening = joined
        commanded = episode.joined(_COMMANDED)
        count = -(-len(planned) // execute)
        index = np.arange(count)[:, None] * execute
        at = np.minimum(index + np.arange(execute), len(planned) - 1)
        plan = np.concatenate([planned[at], ahead[at]], axis=1)[:, ::EVERY]  # [D, H / 2, A, 3]
        tips = tip[at[:, :: execute // TIPS]]
        rows = [np.moveaxis(x, 2, 1).reshape(count, x.shape[2], -1) for x in (plan, tips)]
        rows += [x[at[:, 0], :, None] for x in (opening, commanded)]
        trials.append(np.concatenate(rows, axis=-1).reshape(count, -1))
    whole = np.full((len(trials), -(-max_steps // execute), trials[0].shape[-1]), np.nan)
    for row, values in zip(whole, trials, strict=True):
        row[: len(values)] = values
    return whole.astype(np.float32)


def _stored(table: Any, settings: ScoreSettings) -> dict[str, np.ndarray]:
    """Returns columns and decisions `[A, K, R]` of a table, R decisions of all trials."""
    lengths = -(-table.steps // settings.execute)
    most = round(FAILED_S / settings.period_s)
    lengths = np.where(table.success, lengths, np.minimum(lengths, most))
    arms = table.radius.shape[-1]
    kept = np.arange(table.scores.shape[1]) < lengths[:, None]
    rows = table.scores[kept].reshape(kept.sum(), arms, -1)
    packed = np.round(rows / STEP).astype(np.int16)
    packed[..., 3:-2] -= packed[..., :-5].copy()  # a point from the previous one: smaller files
    packed = np.moveaxis(packed, 0, -1)
    columns = {name: getattr(table, name) for name in COLUMNS}
    return {**columns, "lengths": lengths, "decisions": packed}


if __name__ == "__main__":
    if len(sys.argv) < 5:
        sys.exit(__doc__)
    main(*sys.argv[1:])
