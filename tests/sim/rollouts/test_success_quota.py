"""Which trials are needed: the law, for any chunk, order of ending, and saved work."""

import concurrent.futures
import itertools
import pathlib
import random

import pytest

from starjax.sim.rollouts import episodes, sharing, success_quota


class World:
    """Trials with fates: success, and the number of segments."""

    def __init__(self, seed, trocars=3, rate=0.8):
        self.rng = random.Random(seed)
        self.trocars, self.rate, self.fates, self.groups = trocars, rate, {}, []

    def fate(self, trial):
        drawn = (self.rng.random() < self.rate, self.rng.randint(1, 5))
        return self.fates.setdefault(trial, drawn)

    def simulate(self, group):
        assert len(set(group)) == len(group)
        self.groups.append(group)
        yield from self.simulate_quietly(group)

    def simulate_quietly(self, group):
        for segment in range(1, 6):
            yield [
                episodes.Episode({"trocar": t[0], "trial": t[1], "success": self.fate(t)[0]}, {})
                for t in group
                if self.fate(t)[1] == segment
            ]

    def collected(self, known, per_trocar, chunk, max_workers=1):
        """The trials that are yielded, once each."""
        self.groups = []
        given = success_quota.run(
            self.simulate, dict(known), self.trocars, per_trocar, chunk, max_workers
        )
        found = [episode.trial for episode in given]
        assert len(set(found)) == len(found)
        return set(found)


def needed(world, per_trocar):
    """The law, in other words: trials in order until there are enough successes."""
    wanted = set()
    for trocar in range(world.trocars):
        successes = trial = 0
        while successes < per_trocar:
            wanted.add((trocar, trial))
            successes += world.fate((trocar, trial))[0]
            trial += 1
    return wanted


@pytest.mark.parametrize("seed", range(20))
def test_what_is_collected_is_what_is_needed(seed):
    world = World(seed)
    wanted = needed(world, 5)
    for chunk in (1, 2, 4, 7, 16, 64):
        assert world.collected({}, 5, chunk) == wanted
        assert world.collected({}, 5, chunk, max_workers=3) == wanted


@pytest.mark.parametrize("seed", range(20))
def test_what_is_there_is_not_collected_again(seed):
    world = World(seed)
    wanted = needed(world, 5)
    for chunk in (2, 7, 16):
        world.collected({}, 5, chunk)
        whole = world.groups
        there = set(world.rng.sample(sorted(wanted), len(wanted) // 2))
        known = {trial: world.fate(trial)[0] for trial in there}
        assert world.collected(known, 5, chunk) == wanted - there
        # A chunk is simulated as in a run without interruption, or not begun.
        assert [group for group in whole if group in world.groups] == world.groups
        assert not world.collected(known | {t: world.fate(t)[0] for t in wanted}, 5, chunk)
        assert not world.groups


@pytest.mark.parametrize("seed", range(20))
def test_what_is_there_stays_as_it_is(seed):
    """Simulated again on another machine, a trial may end otherwise."""
    here, elsewhere = World(seed), World(seed)
    fates = {(trocar, 1): elsewhere.fate((trocar, 1)) for trocar in range(3)}
    known = {trial: not success for trial, (success, _) in fates.items()}
    here.fates = {trial: (success, 1) for trial, success in known.items()}
    wanted = needed(here, 5)
    elsewhere.fates = here.fates | fates
    assert elsewhere.collected(known, 5, 4) == wanted - set(known)


def collected_by(world, disk, count, chunk):
    """Trials that so many processes write, from those on the disk."""
    known, written = dict(disk), []

    def process(index):
        share = sharing.Share(pathlib.Path(), index, count, "")
        simulate, poll_results = world.simulate_quietly, lambda: dict(disk)
        for episode in success_quota.run(
            simulate, dict(known), 3, 5, chunk, 1, share, poll_results
        ):
            written.append(episode.trial)
            disk[episode.trial] = episode.outcome["success"]

    with concurrent.futures.ThreadPoolExecutor(count) as pool:
        list(pool.map(process, range(count)))
    return written


@pytest.mark.parametrize("seed", range(10))
def test_processes_that_share_collect_what_one_collects(seed, monkeypatch):
    """Each reads of the others only their files."""
    monkeypatch.setattr(success_quota.sharing, "POLL_S", 0.001)
    for count, chunk in ((2, 4), (3, 2), (2, 64)):
        world = World(seed)
        wanted = needed(world, 5)
        for trial in itertools.product(range(3), range(40)):
            world.fate(trial)  # threads draw no fates
        there = set(world.rng.sample(sorted(wanted), 5))
        disk = {trial: world.fate(trial)[0] for trial in there}
        written = collected_by(world, disk, count, chunk)
        assert sorted(written) == sorted(wanted - there)


def test_a_failure_costs_no_second_round_where_lanes_are_free():
    world = World(0)
    world.fates = {(i, j): (j != 2, 1) for i in range(3) for j in range(20)}
    world.collected({}, 5, 18)
    assert len(world.groups) == 1
    world.collected({}, 5, 15)
    assert len(world.groups) == 2


def test_what_is_not_needed_is_not_waited_for():
    world = World(0)
    world.fates = {(i, j): (True, 1 if j < 5 else 5) for i in range(3) for j in range(20)}
    segments = []
    simulate = world.simulate
    world.simulate = lambda group: (segments.append(s) or s for s in simulate(group))
    world.collected({}, 5, 18)
    assert len(segments) == 1


@pytest.mark.parametrize("chunk", [1, 8, 64])
def test_a_bad_expert_is_an_error_whatever_the_chunk(chunk):
    world = World(0, trocars=1)
    world.fates = {(0, j): (j == 0, 1) for j in range(100)}
    with pytest.raises(ValueError, match="above 50%, got 1 of 18 at trocar 0"):
        world.collected({}, 5, chunk)
