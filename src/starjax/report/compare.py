"""Common ground of runs: the task, the trials that they met, how they were trained."""

import collections
from collections.abc import Iterable, Sequence

from starjax import config, errors
from starjax.evaluation.result import Trial
from starjax.report import outcomes, results, stats
from starjax.report.results import Run
from starjax.sim import registries
from starjax.sim.tasks.base import Task, TaskText

OURS = "stardiff"  # the method that the others are compared with
_NEAR = 1e-5  # of m and rad: machines draw the same trocar with other last bits


def task(runs: Sequence[Run]) -> Task:
    """The task of all runs.

    Raises:
      errors.UsageError: they are of several, or its package is not installed.
    """
    names = sorted({run.result.scene.task for run in runs})
    if len(names) != 1:
        raise errors.UsageError("runs", "results of one task", " and ".join(names))
    return registries.tasks.get(names[0])


def task_text(runs: Sequence[Run]) -> TaskText:
    """Returns the text of the task of all runs; raises as `task`."""
    return task(runs).text


def observed(runs: Sequence[Run]) -> str:
    """Observation of the policies, `state` or `image`, for every output's title."""
    return " and ".join(sorted({run.result.observation for run in runs}))


def identity(trial: Trial) -> tuple[int, int, int]:
    """Pairs the trials that two runs both met: the same trocar, number and seed."""
    return trial.trocar, trial.trial, trial.seed


def most_shared(trials: Iterable[Trial]) -> tuple[int, int, int]:
    """The trial that most runs met, of these an unseen one, of these the first."""
    trials = list(trials)
    counts = collections.Counter(map(identity, trials))
    return identity(min(trials, key=lambda t: (-counts[identity(t)], t.seen, identity(t))))


def differing(runs: Sequence[Run]) -> list[str]:
    """Settings that decide the weights, but for the seed, that the runs do not agree on."""
    return config.differing_settings([run.result.config for run in runs if run.result.config])


def pair(a: Run, b: Run) -> stats.Paired | None:
    """McNemar's test over the trials that both methods ran with the same trocar, seed and limit,
    under the same settings of jax."""
    if a.limit_s != b.limit_s or results.jax_settings(a) != results.jax_settings(b):
        return None
    ours, theirs = ({identity(t): t for t in run.trials} for run in (a, b))
    both = [(ours[k], theirs[k]) for k in sorted(ours.keys() & theirs.keys())]
    met = [(one, other) for one, other in both if _same_place(one, other)]
    if not met:
        return None
    return stats.mcnemar(*([outcomes.strict(t) for t in side] for side in zip(*met, strict=True)))


def representatives(runs: Sequence[Run]) -> list[Run]:
    """One run of each group, in the runs' order: STAR-Diff itself, else the most successful of
    those that met the trials of the first STAR-Diff, if any did."""
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
    """Whether two trials of one identity met the same trocars: sweeps number their own."""
    places = [(*trial.radius, *trial.polar, *trial.azimuth) for trial in (one, other)]
    return len({len(place) for place in places}) == 1 and all(
        abs(a - b) <= _NEAR for a, b in zip(*places, strict=True)
    )
