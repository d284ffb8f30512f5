"""Which trials a dataset needs, and running them: of each trocar all, up to its last success.

Outcomes are known in any order: a trial is needed once the trials before it cannot have all the
successes, and is not once they do have them. Several processes simulate the groups of a wave in
turn and learn from each other's files how the other trials ended: the trials before the first one
that is not known are, so its owner can always say whether it is needed.
"""

import math
from collections.abc import Callable, Generator, Iterator, Mapping

from starjax.rollouts import cores, sharing
from starjax.rollouts.episodes import Episode, Trial

MIN_SUCCESS_RATE = 0.5  # below it at some trocar, the expert is broken and collecting stops

Known = Mapping[Trial, bool]  # whether it succeeded


class ExpertFailed(ValueError):
    """The expert succeeds too rarely to go on collecting."""


def run(
    simulate: Callable[[list[Trial]], Generator[list[Episode]]],
    known: dict[Trial, bool],
    trocars: int,
    per_trocar: int,
    chunk: int,
    at_once: int = 1,
    share: sharing.Share = sharing.ALONE,
    news: Callable[[], Known] = dict,
) -> Iterator[Episode]:
    """Simulates what is needed, `chunk` trials together; yields each episode when that is certain.

    Args:
      simulate: yields a group's episodes as they end.
      known: outcomes of episodes that are there already; the others are added.
      trocars: how many there are.
      per_trocar: successes wanted at each.
      chunk: number of lanes.
      at_once: chunks that are simulated side by side.
      share: of this process.
      news: outcomes that other processes have written since it was last asked.

    Raises:
      ExpertFailed: the expert fails too often.
    """
    there = set(known)
    drawn = [0] * trocars
    waiting: list[Episode] = []

    def learn(outcomes: Known) -> Iterator[Episode]:
        """Yields the episodes of which it is certain, with these outcomes, that they are needed."""
        nonlocal waiting
        for trial, success in outcomes.items():
            # What is on disk stays, also where another machine's last bits end otherwise.
            known.setdefault(trial, success)
        ready = [e for e in waiting if _is_needed(e.trial, known, per_trocar)]
        waiting = [e for e in waiting if not _is_needed(e.trial, known, per_trocar)]
        while ready:  # so that an episode's memory is free once it is written
            episode = ready.pop()
            if episode.trial not in there:
                yield episode

    while wave := _wave(known, drawn, per_trocar, chunk):
        groups = [wave[first : first + chunk] for first in range(0, len(wave), chunk)]
        waiting.clear()  # of the wave before, and not needed

        def is_wanted(group: list[Trial]) -> bool:
            return any(_is_open(trial, known, per_trocar) for trial in group)

        for ended in cores.run(share.mine(groups), simulate, at_once, is_wanted):
            waiting += ended
            outcomes = {episode.trial: episode.outcome["success"] for episode in ended}
            ended.clear()
            yield from learn({**news(), **outcomes})
        while any(_is_open(trial, known, per_trocar) for trial in wave):
            share.pause()
            yield from learn(news())


def _wave(known: Known, drawn: list[int], per_trocar: int, chunk: int) -> list[Trial]:
    """The next trials: as many at each trocar as it lacks successes, and more in the lanes left.

    Updates `drawn`, the trials drawn so far at each trocar.
    """
    limit = math.ceil(8 + per_trocar / MIN_SUCCESS_RATE)
    wave, lacking = [], []

    def draw(trocar: int) -> None:
        wave.append((trocar, drawn[trocar]))
        drawn[trocar] += 1

    for trocar, first in enumerate(drawn):
        done = sum(known.get((trocar, i), False) for i in range(first))
        if done >= per_trocar:
            continue
        if first >= limit:
            raise ExpertFailed(
                f"expert: expected a success rate above {MIN_SUCCESS_RATE:.0%}, "
                f"got {done} of {first} at trocar {trocar}"
            )
        lacking.append(trocar)
        for _ in range(min(per_trocar - done, limit - first)):
            draw(trocar)
    # A failure then costs no further wave, which would take as long as this one for a few trials.
    while -len(wave) % chunk and (lacking := [i for i in lacking if drawn[i] < limit]):
        for trocar in lacking[: -len(wave) % chunk]:
            draw(trocar)
    return wave


def _is_needed(trial: Trial, known: Known, per_trocar: int) -> bool:
    """Whether the trial is needed even if every unfinished one before it succeeds."""
    return sum(known.get((trial[0], i), True) for i in range(trial[1])) < per_trocar


def _is_open(trial: Trial, known: Known, per_trocar: int) -> bool:
    """Whether it is not over, and may be needed."""
    before = sum(known.get((trial[0], i), False) for i in range(trial[1]))
    return trial not in known and before < per_trocar
