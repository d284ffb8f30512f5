"""Runs trials until every trocar configuration has its quota of successes.

A configuration needs its trials in order, up to the one with its last success of the quota. Trials
end in any order, so an episode is yielded once its need is certain, i.e. when the trials before
it cannot fill the quota, even if all unfinished ones succeed.

Trials are drawn in rounds, and a round's groups are split over processes. Each process reads the
other processes' outcomes from their files. The trials before the first unfinished one all have
outcomes, so the process that owns it can always decide: no process waits for itself.
"""

import math
from collections.abc import Callable, Generator, Iterator, Mapping

from starjax.sim.rollouts import sharing, workers
from starjax.sim.rollouts.episodes import Episode, Trial

MIN_SUCCESS_RATE = 0.5  # collecting stops below it, as the expert is broken
SPARE_TRIALS = 8  # above the number that `MIN_SUCCESS_RATE` allows, for small quotas

Results = Mapping[Trial, bool]  # True: success


class ExpertFailed(ValueError):
    """The expert succeeds too rarely for a dataset."""


def run(
    simulate: Callable[[list[Trial]], Generator[list[Episode]]],
    results: dict[Trial, bool],
    trocars: int,
    per_trocar: int,
    chunk: int,
    max_workers: int = 1,
    share: sharing.Share = sharing.ALONE,
    poll_results: Callable[[], Results] = dict,
) -> Iterator[Episode]:
    """Simulates the needed trials, `chunk` of them together; yields each needed episode.

    Args:
      simulate: yields a group's episodes as they end.
      results: outcomes of stored episodes; new outcomes are added.
      trocars: number of configurations.
      per_trocar: quota of successes at each.
      chunk: number of lanes.
      max_workers: chunks simulated in parallel.
      share: of this process.
      poll_results: returns the outcomes that other processes have stored since its last call.

    Raises:
      ExpertFailed: the expert fails too often.
    """
    stored = set(results)  # are not yielded again
    drawn = [0] * trocars
    undecided: list[Episode] = []

    def record(outcomes: Results) -> Iterator[Episode]:
        """Adds outcomes; yields the episodes whose need they make certain."""
        nonlocal undecided
        for trial, success in outcomes.items():
            # A stored outcome stays, even if another machine's rounding ends the trial otherwise.
            results.setdefault(trial, success)
        needed = [e for e in undecided if _is_needed(e.trial, results, per_trocar)]
        undecided = [e for e in undecided if not _is_needed(e.trial, results, per_trocar)]
        while needed:  # popped, which frees an episode's memory once it is written
            episode = needed.pop()
            if episode.trial not in stored:
                yield episode

    def has_open_trial(group: list[Trial]) -> bool:
        return any(_is_open(trial, results, per_trocar) for trial in group)

    while trials := _next_trials(results, drawn, per_trocar, chunk):
        groups = [trials[first : first + chunk] for first in range(0, len(trials), chunk)]
        undecided.clear()  # superfluous episodes of the round before
        for ended in workers.run(share.mine(groups), simulate, max_workers, has_open_trial):
            undecided += ended
            # Before the list is cleared, which frees the episodes' images.
            outcomes = {episode.trial: episode.outcome["success"] for episode in ended}
            ended.clear()
            yield from record({**poll_results(), **outcomes})
        while has_open_trial(trials):
            share.pause()
            yield from record(poll_results())


def _next_trials(results: Results, drawn: list[int], per_trocar: int, chunk: int) -> list[Trial]:
    """Draws the next round: at each trocar as many trials as it lacks successes, then spare ones.

    Updates `drawn`, the trials drawn so far at each trocar.
    """
    limit = math.ceil(SPARE_TRIALS + per_trocar / MIN_SUCCESS_RATE)
    trials, lacking = [], []

    def draw(trocar: int) -> None:
        trials.append((trocar, drawn[trocar]))
        drawn[trocar] += 1

    for trocar, count in enumerate(drawn):
        successes = _successes_before((trocar, count), results, unfinished=False)
        if successes >= per_trocar:
            continue
        if count >= limit:
            raise ExpertFailed(
                f"expert: expected a success rate above {MIN_SUCCESS_RATE:.0%}, "
                f"got {successes} of {count} at trocar {trocar}"
            )
        lacking.append(trocar)
        for _ in range(min(per_trocar - successes, limit - count)):
            draw(trocar)
    # Spare trials fill the last chunk's free lanes: a failure then costs no further round, which
    # takes as long as this one, for a few trials.
    while -len(trials) % chunk and (lacking := [i for i in lacking if drawn[i] < limit]):
        for trocar in lacking[: -len(trials) % chunk]:
            draw(trocar)
    return trials


def _is_needed(trial: Trial, results: Results, per_trocar: int) -> bool:
    """Returns True if even successes of all unfinished trials before this one leave a quota."""
    return _successes_before(trial, results, unfinished=True) < per_trocar


def _is_open(trial: Trial, results: Results, per_trocar: int) -> bool:
    """Returns True if the trial is unfinished and may be needed."""
    before = _successes_before(trial, results, unfinished=False)
    return trial not in results and before < per_trocar


def _successes_before(trial: Trial, results: Results, unfinished: bool) -> int:
    """Counts successes at the same trocar before `trial`, unfinished trials as given."""
    trocar, number = trial
    return sum(results.get((trocar, i), unfinished) for i in range(number))
