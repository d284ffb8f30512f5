"""Trials that calibrate and test a runtime monitor: their scores, all by one compiled program.

    python benchmarks/monitor_trials.py POLICY OUT.npz STILL_S BATCHES EACH [NAME=LEVEL ...]

Runs EACH trials at every trocar of the task, undisturbed and under each disturbance, and BATCHES
times as many undisturbed ones with a sampled trocar each: batches of one size share a program.
OUT.npz has the columns of monitors.py, which calibrates from them without a GPU.
"""

import dataclasses
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import monitors
import numpy as np

from starjax.cli import policy_args, policy_evaluation, scenes, session
from starjax.core import config
from starjax.evaluation import disturbances, sweep
from starjax.evaluation.disturbances import base
from starjax.policies import policy_file
from starjax.policies.monitor.scores import ScoreSettings
from starjax.rcm.trocar import Trocar
from starjax.runtime import files

TIME_LIMIT_S = 30.0


class Trials(NamedTuple):
    """Trials of one evaluation.

    Attributes:
      trocars: fields `[C, A]`.
      each: trials at each of them.
      seed: of the trials.
      levels: of the disturbances; the others are zero.
    """

    trocars: Trocar
    each: int
    seed: int
    levels: Mapping[str, float]


def main(policy: str, out: str, still_s: str, batches: str, each: str, *levels: str) -> None:
    """Runs the trials and writes their columns and provenance."""
    session.start_jax(*session.POLICY_MODULES)
    kinds = disturbances.parse_levels("disturbance", levels)
    who = disturbable(policy, kinds)
    task, execute = who.env.task, who.trained.policy.execute
    still = max(1, round(float(still_s) * who.env.control_hz / execute))
    settings = ScoreSettings(execute, who.env.control_hz, still)
    size = len(task.trocars.radius) * int(each)
    seeds = range(1, int(batches) + 1)  # evaluations elsewhere have seed 0
    sampled = {
        f"trials-{seed}": Trials(sweep.sample(seed, size, task), 1, seed, {}) for seed in seeds
    }
    at_task = {"0": Trials(task.trocars, int(each), 0, {})}
    for name, level in kinds.items():
        at_task[f"{name}-{level:g}"] = Trials(task.trocars, int(each), 0, {name: level})
    folder = Path(out).with_suffix("")
    path = policy_args.resolve(policy_args.PolicyArgs(policy=policy))
    # Those of the file: a GPU's inference rounds them.
    digest = policy_file.monitor_digest(policy_file.load(path.file).params)
    about = {"weights": who.weights, "monitor": {"settings": settings._asdict(), "digest": digest}}
    tables: dict[str, Any] = {}
    for label, table in evaluations(folder, who, settings, {**sampled, **at_task}):
        tables[label] = table
        if sampled.keys() <= tables.keys():  # again after each set: a run may be cut off
            ended = {name: x for name, x in kinds.items() if f"{name}-{x:g}" in tables}
            files.write_npz(Path(out), _arrays(folder, tables, list(sampled), ended, about))


def _arrays(
    folder: Path,
    tables: Mapping[str, Any],
    sampled: list[str],
    levels: Mapping[str, float],
    about: dict[str, Any],
) -> dict[str, np.ndarray]:
    """Returns the columns of the ended sets, and the JSON files that monitors.py reads."""
    arrays = {
        f"{label}/{name}": getattr(table, name)
        for label, table in tables.items()
        if label not in sampled
        for name in monitors.COLUMNS
    }
    for name in monitors.COLUMNS:
        arrays[f"trials/{name}"] = np.concatenate([getattr(tables[x], name) for x in sampled])
    command = ["python", "benchmarks/monitor_trials.py", *sys.argv[1:]]
    made = session.Session(" ".join(command), folder)
    registry = disturbances.DISTURBANCES
    tested = {
        name: {"unit": registry.get(name).unit, "levels": [f"{level:g}"]}
        for name, level in levels.items()
    }
    for name, content in {"monitor.json": about, "stress.json": {"disturbances": tested}}.items():
        arrays[name] = np.frombuffer(made.write(name, content).read_bytes(), np.uint8)
    return arrays


def disturbable(policy: str, levels: Mapping[str, float]) -> Any:
    """Returns a policy in an environment whose program has every level of these disturbances."""
    who, _ = policy_args.load(policy_args.resolve(policy_args.PolicyArgs(policy=policy)))
    env = scenes.disturbable(who.env, list(levels), who.trained.policy)
    return who._replace(env=base.with_disturbances(env, list(levels)))


def evaluations(
    folder: Path, who: Any, settings: ScoreSettings, sets: Mapping[str, Trials]
) -> Iterator[tuple[str, Any]]:
    """Runs all trials; yields labels and tables with scores.

    Every disturbance of a set must be one of the environment's.
    """
    run = config.EvalConfig(time_limit_s=TIME_LIMIT_S, video_trials=0)
    everything = {name: 0.0 for given in sets.values() for name in given.levels}
    for label, given in sets.items():
        evaluation = dataclasses.replace(run, trials=given.each)
        levels = {**everything, **given.levels}
        table = policy_evaluation.rollouts(
            folder / label, who, given.trocars, evaluation, given.seed, levels, settings
        )
        print(label, table.success.mean(), flush=True)
        yield label, table


if __name__ == "__main__":
    if len(sys.argv) < 6:
        sys.exit(__doc__)
    main(*sys.argv[1:])
