"""Comparisons of runs: shared task, shared trials, differences in training."""

import collections
from collections.abc import Iterable, Sequence

from starjax import config_json, errors
from starjax.evaluation.result import Trial
from starjax.report import outcomes, results, stats
from starjax.report.results import Run
from starjax.sim import registries
from starjax.sim.tasks.base import Task, TaskText

OURS = "stardiff"  # reference of the comparisons
_NEAR = 1e-5  # m and rad: last bits of a drawn trocar vary between machines


def task(runs: Sequence[Run]) -> Task:
    """Returns the task of all runs.

    Raises:
      errors.UsageError: they have several tasks, or the task's package is not installed.
    """
    names = sorted({run.result.scene.task for run in runs})
    if len(names) != 1:
        raise errors.UsageError("runs", "results of one task", " and ".join(names))
    return registries.tasks.get(names[0])


def task_text(runs: Sequence[Run]) -> TaskText:
    """Returns the text of the task of all runs; raises as `task`."""
    return task(runs).text


def observed(runs: Sequence[Run]) -> str:
    """Returns the observation of the policies, `state` or `image`, for titles."""
    return " and ".join(sorted({run.result.observation for run in runs}))


def identity(trial: Trial) -> tuple[int, int, int]:
    """Returns the key that pairs trials of two runs: trocar, number and seed."""
    return trial.trocar, trial.trial, trial.seed


def most_shared(trials: Iterable[Trial]) -> tuple[int, int, int]:
    """Selects the trial that most runs share, preferring unseen trocars, then the first."""
    trials = list(trials)
    counts = collections.Counter(map(identity, trials))
    return identity(min(trials, key=lambda t: (-counts[identity(t)], t.seen, identity(t))))


def differing(runs: Sequence[Run]) -> list[str]:
    """Lists the training settings, except the seed, that differ between the runs."""
    return config_json.differing_settings([run.result.config for run in runs if run.result.config])


def pair(a: Run, b: Run) -> stats.Paired | None:
    """Applies McNemar's test to the trials that two runs share.

    Shared trials have the same trocar, seed, time limit and settings of jax; None without any.
    """
    if a.limit_s != b.limit_s or results.jax_settings(a) != results.jax_settings(b):
        return None
    ours, theirs = ({identity(t): t for t in run.trials} for run in (a, b))
    both = [(ours[k], theirs[k]) for k in sorted(ours.keys() & theirs.keys())]
    met = [(one, other) for one, other in both if _same_place(one, other)]
    if not met:
        return None
    return stats.mcnemar(*([outcomes.strict(t) for t in side] for side in zip(*met, strict=True)))


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


def _same_place(one: Trial, other: Trial) -> bool:
    """Returns True if two trials of one identity have the same trocars: sweeps number their own."""
    places = [(*trial.radius, *trial.polar, *trial.azimuth) for trial in (one, other)]
    return len({len(place) for place in places}) == 1 and all(
        abs(a - b) <= _NEAR for a, b in zip(*places, strict=True)
    )
