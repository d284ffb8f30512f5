"""Comparisons of runs: shared task, shared trials, differences in training."""

import collections
from collections.abc import Iterable, Sequence

from starjax.core import config_json, errors
from starjax.evaluation import paired
from starjax.evaluation.result import Trial
from starjax.report import outcomes
from starjax.report.results import Run
from starjax.sim import registries
from starjax.sim.task import Task, TaskText

OURS = "stardiff"  # reference of the comparisons


def task(runs: Sequence[Run]) -> Task:
    """Returns the task of all runs.

    Raises:
      errors.UsageError: they have several tasks, or the task's package is not installed.
    """
    names = sorted({run.result.scene.task for run in runs})
    if len(names) != 1:
        raise errors.UsageError("RUN", "results of one task", " and ".join(names))
    return registries.tasks.get(names[0])


def task_text(runs: Sequence[Run]) -> TaskText:
    """Returns the text of the task of all runs; raises as `task`."""
    return task(runs).text


def observed(runs: Sequence[Run]) -> str:
    """Returns the observation of the policies, `state` or `image`, for titles."""
    return " and ".join(sorted({run.result.observation for run in runs}))


def most_shared(trials: Iterable[Trial]) -> tuple[int, int, int]:
    """Selects the trial that most runs share, preferring unseen trocars, then the first."""
    trials = list(trials)
    counts = collections.Counter(map(paired.identity, trials))
    return paired.identity(
        min(trials, key=lambda t: (-counts[paired.identity(t)], t.seen, paired.identity(t)))
    )


def differing(runs: Sequence[Run]) -> list[str]:
    """Lists the training settings, except the seed, that differ between the runs."""
    return config_json.differing_settings([run.result.config for run in runs if run.result.config])


def pair(a: Run, b: Run) -> paired.Paired | None:
    """Applies McNemar's test to the trials that two runs share; None without any."""
    return paired.paired(a.result, b.result) if paired.shared(a.result, b.result) else None


def representatives(runs: Sequence[Run]) -> list[Run]:
    """Selects one run of each group, in the runs' order.

    STAR-Diff represents its group; elsewhere the most successful run does, preferring runs with
    the trials of the first STAR-Diff.
    """
    seed = next((run.result.seed for run in runs if run.result.method == OURS), None)

    def standing(run: Run) -> tuple[bool, bool, float]:
        is_ours, same_trials = run.result.method == OURS, run.result.seed == seed
        return is_ours, same_trials, outcomes.tally(run.trials).rate

    groups = [
        [run for run in runs if run.trials and run.group == g] for g in {r.group for r in runs}
    ]
    best = [max(group, key=standing) for group in groups if group]
    return [run for run in runs if any(run is chosen for chosen in best)]
