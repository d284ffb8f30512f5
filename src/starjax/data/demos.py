"""Collects demonstrations: an agent at every configuration of trocars, all trials as one program.

- What is drawn: of each configuration all trials up to the one that completes its successes.
- In which order: in waves, at first `per_trocar` of each, then as many as failed. Lanes that a wave
  leaves free run the trials that come next; those that were not needed are dropped.
- What makes it reproducible: the description and the seed decide it and, in the last bits, the size
  of the batch, which a machine's memory and devices decide. A wave's chunks are the same in every
  run, and a chunk with a missing episode is simulated again as a whole.
- After a kill: the same command on the same machine ends in the same bytes. Episodes are written as
  they end, while the rest of their chunk and the next are simulated.
"""

import collections
import concurrent.futures
import contextlib
import math
from collections.abc import Callable, Generator, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from starjax import errors
from starjax.data import schema, store
from starjax.data.schema import Settings
from starjax.rcm.trocar import Trocar
from starjax.rollouts import cores, engine, episodes, waves
from starjax.rollouts import trocars as configurations
from starjax.rollouts.agent import BatchAgent
from starjax.rollouts.placement import ANYWHERE, Place
from starjax.runtime import files, progress, xla

COMMITS = 16  # episodes written at once; most of it is waiting for the disk
FRAME_GUESS = 300  # control steps of a typical demonstration, for estimates of disk and memory
MEMORY_SHARE = 0.25  # of the host's, for images of the episodes that are simulated together
GPU_LANES = 256  # episodes a GPU simulates together


def collect(
    root: Path,
    env: Any,
    agent: BatchAgent,
    trocars: Trocar,
    settings: Settings,
    *,
    params: Any = None,
    place: Place = ANYWHERE,
    report: Callable[[str], None] = print,
) -> dict[str, Any]:
    """Collects what is missing of a dataset, and seals it.

    Args:
      root: folder of the dataset.
      env: `sim.env.Env`; its observation decides whether images or task states are stored.
      agent: what it says is to be recorded is the command of a demonstration.
      trocars: fields `[C, A]`.
      params: of the agent.
      report: gets lines for the user.

    Returns:
      {"digest", "episodes", "trials", "frames"}: the dataset's hash, successes kept, trials drawn
      for them, frames stored.

    Raises:
      StorageError: the folder cannot be read or written, is in use, holds another dataset, or is
        too small.
      ValueError: an argument out of range, a trocar that is none, an agent that fails too often.
    """
    if settings.per_trocar < 1 or settings.max_steps < 1 or place.lanes < 0:
        got = (settings.per_trocar, settings.max_steps, place.lanes)
        raise errors.UsageError("per_trocar, max_steps, lanes", "1, 1 and 0 or more", got)
    trocars = configurations.listed(trocars, len(env.p_world_ref))
    total = settings.per_trocar * len(trocars.radius)
    with files.lock(root):
        description = schema.describe(env, trocars, settings)
        store.create(root, description)
        store.clean(root)
        records = _sound(root, settings.seed, report)
        done = sum(r["success"] for r in records.values())
        frame_bytes = _frame_bytes(description)
        files.require_writable(
            root, max(total - done, 0) * min(settings.max_steps, FRAME_GUESS) * frame_bytes
        )
        lanes, at_once = _size(place, total, frame_bytes)
        simulate = _simulator(env, agent, params, trocars, settings, place._replace(lanes=lanes))
        known = {(r["trocar"], r["trial"]): r["success"] for r in records.values()}

        def commit(episode: episodes.Episode) -> store.Record:
            outcome = episode.outcome
            key = store.key(*episode.trial, settings.seed)
            kept = outcome["success"] or settings.keep_failures
            return store.commit(root, key, outcome, episode.arrays if kept else {})

        def note(record: store.Record) -> None:
            records[record["key"]] = record
            advance(int(record["success"]))

        needed = waves.run(
            simulate, known, len(trocars.radius), settings.per_trocar, lanes, at_once
        )
        shown = progress.track("Demonstrations", total, unit="episodes", done=done)
        with shown as advance, _writer(commit, note, lanes) as write:
            for episode in needed:
                write(episode)
        digest = store.seal(root, records)
    return {
        "digest": digest,
        "episodes": sum(record["success"] for record in records.values()),
        "trials": len(records),
        "frames": sum(record["length"] for record in records.values() if record["files"]),
    }


def _simulator(
    env: Any,
    agent: BatchAgent,
    params: Any,
    trocars: Trocar,
    settings: Settings,
    place: Place,
) -> Callable[[list[episodes.Trial]], Generator[list[episodes.Episode]]]:
    rules = engine.Settings(settings.seed, schema.STREAM, settings.max_steps, place.lanes)
    run = engine.make(env, agent, trocars, rules, episodes.DEMONSTRATION, place.devices)

    def simulate(group: list[episodes.Trial]) -> Generator[list[episodes.Episode]]:
        for segment in run(params, group):
            yield segment.ended

    return simulate


def _sound(root: Path, seed: int, report: Callable[[str], None]) -> dict[str, store.Record]:
    """Records of the episodes on disk; damaged ones are removed, to be collected again.

    Raises:
      StorageError: one is of another seed, so that a lost dataset.json was of another dataset.
    """
    records = {}
    for key, found in store.verify_all(root, store.keys(root)).items():
        if isinstance(found, store.DamagedEpisode):
            report(f"damaged, collected again: {found}")
            (root / "SEALED.json").unlink(missing_ok=True)
            store.remove(root, key)
        elif found["seed"] != seed:
            raise files.StorageError(
                f"{root} holds another dataset: {key} is of seed {found['seed']}, not {seed}; "
                "choose another folder, or remove this one"
            )
        else:
            records[key] = found
    return records


@contextlib.contextmanager
def _writer(
    commit: Callable[[episodes.Episode], store.Record],
    note: Callable[[store.Record], None],
    limit: int,
) -> Iterator[Callable[[episodes.Episode], None]]:
    """Yields a function that has an episode committed in a thread; `note` hears of it when it is.

    The function waits while more than `limit` are under way, and the end for all of them; after an
    error or an interrupt, those not begun are left out.
    """
    pool = concurrent.futures.ThreadPoolExecutor(COMMITS)
    under_way = collections.deque()

    def settle(most: int) -> None:
        while under_way and (len(under_way) > most or under_way[0].done()):
            note(under_way.popleft().result())

    def write(episode: episodes.Episode) -> None:
        under_way.append(pool.submit(commit, episode))
        settle(limit)

    try:
        yield write
        settle(0)
    finally:
        pool.shutdown(cancel_futures=True)


def _frame_bytes(description: dict[str, Any]) -> int:
    """Of one recorded control step."""
    features = description["features"].values()
    return sum(math.prod(x["shape"]) * np.dtype(x["dtype"]).itemsize for x in features)


def _size(place: Place, total: int, frame_bytes: int) -> tuple[int, int]:
    """Lanes of a chunk, and chunks that are simulated side by side."""
    fits = int(MEMORY_SHARE * xla.memory_bytes() // (2 * FRAME_GUESS * frame_bytes))
    lanes = place.lanes or max(1, min(_fast(place.devices, total), fits))
    at_once = max(1, min(cores.count(), fits // lanes))
    several = len(place.devices or [0])
    return -(-lanes // several) * several, at_once


def _fast(devices: Sequence[jax.Device] | None, total: int) -> int:
    """Episodes that make the most of a program, where `total` are wanted: several GPUs share what
    one would do alone. Not of what is there already, as the size of a batch may change last bits.
    """
    if jax.default_backend() == "cpu":
        return cores.CPU_LANES
    return GPU_LANES * min(len(devices or [0]), -(-total // GPU_LANES))
