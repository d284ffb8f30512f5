"""Rollouts of one round of fine-tuning, and the dataset of those that are learned.

<root>/dataset.json, episodes/, SEALED.json   the dataset, see `data.store`
<root>/chunk_<n>.npz                          outcomes of all trials; missing ones are run again

Trials of a round are a function of seed, round and policy. Their stream is apart from those of
demonstrations and evaluations.
"""

from collections.abc import Callable, Generator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from starjax.core import sources
from starjax.data import schema, store
from starjax.evaluation.evaluate import lanes_per_device
from starjax.rcm.trocar import Trocar
from starjax.sim import env as sim_env
from starjax.sim.rollouts import chunks, engine, episodes, sharing, takeover
from starjax.sim.rollouts import trocars as configurations
from starjax.sim.rollouts.agent import BatchAgent
from starjax.sim.rollouts.placement import DEFAULT_LAYOUT, DeviceLayout
from starjax.sim.state import Env

Job = tuple[episodes.Trial, int]  # a trial and the number of its run, see `Way`

STREAM = 0x66696E65  # the first round's, folded into the seed's key


class LearnedEpisode(NamedTuple):
    """An episode that is learned.

    Attributes:
      episode: its fields include `actor`.
      first: first control step that is stored.
      run: position of the episode among the runs of its trial.
      about: further entries of its record.
    """

    episode: episodes.Episode
    first: int
    run: int
    about: Mapping[str, Any]


class Way(NamedTuple):
    """Search for episodes to learn.

    A run of a trial is its start with a number, which the agent's parameters depend on.

    Attributes:
      source: `source` of the episodes' records.
      agent: acts in the trials.
      params: (numbers `[N]` int32 of the runs) -> parameters of the agent.
      runs: numbers of each trial's first runs.
      again: episodes of these -> numbers of its further runs.
      record: of the trials.
      choose: episodes of a trial, one per run -> the one that is learned, or None.
      cause: the same -> a word that the outcomes count.
      parts: identities of the code that decides it, for the description.
    """

    source: str
    agent: BatchAgent
    params: Callable[[np.ndarray], Any]
    runs: tuple[int, ...]
    record: episodes.Record
    choose: Callable[[Sequence[episodes.Episode]], LearnedEpisode | None]
    cause: Callable[[Sequence[episodes.Episode]], str]
    parts: tuple[sources.Identity, ...] = ()
    again: Callable[[Sequence[episodes.Episode]], Sequence[int]] = lambda found: ()


class RoundSettings(NamedTuple):
    """Settings of a round.

    Attributes:
      number: of the round, from 0 on.
      seed: of all rounds.
      trials: at each configuration of trocars.
      max_steps: control steps after which a trial has failed.
      expert: key of `Task.experts`, for the description.
      policy: digest of the policy.
      about: further values that decide the rollouts, for the description.
    """

    number: int
    seed: int
    trials: int
    max_steps: int
    expert: str
    policy: str
    about: Mapping[str, Any]


class Outcomes(NamedTuple):
    """M trials of a round.

    Attributes:
      trocar, trial: `[M]` int32.
      success: `[M, R]` bool, of the first runs.
      kept: `[M]` bool, True for those in the dataset.
      run: `[M]` int32, position of the kept run, -1 if none is.
      cause: `[M]` str, see `Way`.
    """

    trocar: np.ndarray
    trial: np.ndarray
    success: np.ndarray
    kept: np.ndarray
    run: np.ndarray
    cause: np.ndarray


def describe(env: Env, trocars: Trocar, way: Way, settings: RoundSettings) -> dict[str, Any]:
    """Returns the content of dataset.json."""
    recorded = env if way.record.observes else sim_env.without_images(env)
    plain = schema.DemoSettings(
        settings.trials, settings.seed, settings.max_steps, expert=settings.expert
    )
    description = schema.describe(recorded, trocars, plain)
    stream = STREAM + settings.number
    added = sources.record(way.parts)
    return {
        **takeover.with_actor(description, way.source, settings.policy),
        **{name: {**description[name], **values} for name, values in added.items()},
        "stream": stream,
        "seed_rule": schema.seed_rule(stream),
        **settings.about,
    }


def collect(
    root: Path,
    env: Env,
    trocars: Trocar,
    way: Way,
    settings: RoundSettings,
    *,
    layout: DeviceLayout = DEFAULT_LAYOUT,
    report: Callable[[str], None] = print,
) -> Outcomes:
    """Runs the missing trials of a round; stores the episodes that are learned.

    Args:
      root: folder of the round's dataset.
      env: `sim.env.Env` with the policy's observation.
      trocars: fields `[C, A]`.
      way: of the search.
      settings: of the round.
      layout: lanes and devices; lanes 0 stands for those of an evaluation.
      report: gets lines for the user.

    Raises:
      StorageError: the folder cannot be written, is in use, or holds another dataset.
    """
    trocars = configurations.listed(trocars, len(env.p_world_ref))
    group = [(i, k) for i in range(len(trocars.radius)) for k in range(settings.trials)]
    several = len(layout.devices or [0])
    device = (layout.devices or jax.local_devices())[0]
    lanes = several * (layout.lanes or lanes_per_device(device, -(-len(group) // several)))
    stream = STREAM + settings.number
    rules = engine.RolloutSettings(settings.seed, stream, settings.max_steps, lanes)
    run = engine.make(env, way.agent, trocars, rules, way.record, layout.devices)
    spans = [slice(first, first + lanes) for first in range(0, len(group), lanes)]

    def check(number: int, arrays: chunks.Arrays) -> None:
        if different := {*Outcomes._fields} ^ arrays.keys():
            raise ValueError(f"{min(different)} is missing or too much")
        trials = [arrays[name].tolist() for name in ("trocar", "trial")]
        if list(zip(*trials, strict=True)) != group[spans[number]]:
            raise ValueError("it holds other trials")

    def make(number: int) -> Generator[float, None, chunks.Arrays]:
        trials = group[spans[number]]

        def play(jobs: Sequence[Job], units: float) -> Generator[float, None, list[Any]]:
            """Runs at most `lanes` jobs; yields parts of `units`, returns their episodes."""
            numbers = np.array([n for _, n in jobs] + [jobs[0][1]] * (lanes - len(jobs)), np.int32)
            passed, ended = 0.0, []
            for segment in run(way.params(numbers), [trial for trial, _ in jobs]):
                ended += segment.ended
                yield (segment.passed - passed) * units
                passed = segment.passed
            return sorted(ended, key=lambda episode: episode.lane)

        first = []
        for n in way.runs:
            part = yield from play([(trial, n) for trial in trials], len(trials) / len(way.runs))
            first.append(part)
        found = {trial: [part[i] for part in first] for i, trial in enumerate(trials)}
        won = [[episode.outcome["success"] for episode in runs] for runs in found.values()]
        jobs = [(trial, n) for trial, runs in found.items() for n in way.again(runs)]
        for start in range(0, len(jobs), lanes):
            for episode in (yield from play(jobs[start : start + lanes], 0.0)):
                found[episode.trial].append(episode)
        kept = {trial: way.choose(runs) for trial, runs in found.items()}
        for trial, one in kept.items():
            if one is not None:
                _commit(root, store.key(*trial, settings.seed), way, settings, one)
        return {
            "trocar": np.array([trial[0] for trial in trials], np.int32),
            "trial": np.array([trial[1] for trial in trials], np.int32),
            "success": np.array(won),
            "kept": np.array([one is not None for one in kept.values()]),
            "run": np.array([-1 if one is None else one.run for one in kept.values()], np.int32),
            "cause": np.array([way.cause(runs) for runs in found.values()]),
        }

    with sharing.shared(root) as share:
        share.first("described", lambda: _prepare(root, describe(env, trocars, way, settings)))
        paths = [root / f"chunk_{number:04d}.npz" for number in range(len(spans))]
        parts = chunks.Parts(paths, [len(group[rows]) for rows in spans], check, make)
        made = chunks.complete(share, parts, "Rollouts", "trials", report)
        share.first("sealed", lambda: _seal(root))
    return Outcomes(*(np.concatenate([part[name] for part in made]) for name in Outcomes._fields))


def _prepare(root: Path, description: dict[str, Any]) -> None:
    store.create(root, description)
    store.clean(root)


def _commit(root: Path, key: str, way: Way, settings: RoundSettings, kept: LearnedEpisode) -> None:
    """Writes an episode, unless a killed run has done so."""
    if (root / "episodes" / key).exists():
        return
    arrays = {
        name: [kept.episode.joined(name)[kept.first :]]
        for name in kept.episode.arrays
        if name in episodes.FIELDS
    }
    outcome = {
        **kept.episode.outcome,
        "length": kept.episode.outcome["length"] - kept.first,
        "source": way.source,
        "policy": settings.policy,
        "first": kept.first,
        **kept.about,
    }
    store.commit(root, key, outcome, arrays)


def _seal(root: Path) -> str:
    records = {key: store.verify(root, key, arrays=False) for key in store.keys(root)}
    return store.seal(root, records)
