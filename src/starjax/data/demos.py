"""Collects demonstrations: an agent at every configuration of trocars, all trials as one program.

- What is drawn: of each configuration all trials up to the one that completes its successes.
- In which order: in waves, at first `per_trocar` of each, then as many as failed. Lanes that a wave
  leaves free run the trials that come next; those that were not needed are dropped.
- What makes it reproducible: the description and the seed decide it and, in the last bits, the size
  of the batch, which a machine's memory and devices decide. A wave's chunks are the same in every
  run, and a chunk with a missing episode is simulated again as a whole.
- By whom: several processes simulate the chunks of a wave in turn, and write into one folder.
- After a kill: the same command on the same machine ends in the same bytes. Episodes are written as
  they end, while the rest of their chunk and the next are simulated.
"""

import collections
import concurrent.futures
import contextlib
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from starjax.core import errors
from starjax.data import schema, store, windows
from starjax.data.schema import DemoSettings
from starjax.rcm.trocar import Trocar
from starjax.runtime import files, progress, xla
from starjax.sim.rollouts import engine, episodes, sharing, success_quota, workers
from starjax.sim.rollouts import trocars as configurations
from starjax.sim.rollouts.agent import BatchAgent
from starjax.sim.rollouts.placement import DEFAULT_LAYOUT, DeviceLayout
from starjax.sim.state import Env
from starjax.sim.task import Task

COMMITS = 16  # threads that write episodes; they mostly wait for the disk
FRAME_GUESS = 300  # control steps of a typical demonstration, for estimates of disk and memory
MEMORY_SHARE = 0.25  # part of the host's, for images of the episodes that are simulated together
GPU_LANES = 256  # episodes a GPU simulates together


def collect(
    root: Path,
    env: Env,
    agent: BatchAgent,
    trocars: Trocar,
    settings: DemoSettings,
    *,
    params: Any = None,
    layout: DeviceLayout = DEFAULT_LAYOUT,
    report: Callable[[str], None] = print,
) -> dict[str, Any]:
    """Collects what is missing of a dataset, and seals it.

    Args:
      root: folder of the dataset.
      env: `sim.env.Env`; its observation decides whether images or task states are stored.
      agent: its recorded command is the command of the demonstration.
      trocars: fields `[C, A]`.
      params: of the agent.
      report: gets lines for the user.

    Returns:
      {"digest", "episodes", "trials", "frames"}: the dataset's hash, successes kept, trials drawn
      for them, frames stored.

    Raises:
      StorageError: the folder cannot be read or written, is in use, holds another dataset, or is
        too small.
      ValueError: an argument out of range, an invalid trocar, or an agent that fails too often.
    """
    if settings.per_trocar < 1 or settings.max_steps < 1 or layout.lanes < 0:
        got = (settings.per_trocar, settings.max_steps, layout.lanes)
        raise errors.UsageError("per_trocar, max_steps, lanes", "1, 1 and 0 or more", got)
    trocars = configurations.listed(trocars, len(env.p_world_ref))
    total = settings.per_trocar * len(trocars.radius)
    description = schema.describe(env, trocars, settings)
    with sharing.shared(root) as share:
        share.first("sound", lambda: _prepare(root, description, settings, total, report))
        records = _records(root, store.keys(root))
        frame_bytes = schema.frame_bytes(description["features"])
        lanes = share.first("lanes", lambda: _lanes(layout, total, frame_bytes, share.count))
        max_workers = max(1, min(workers.worker_count(), _fitting(frame_bytes) // lanes))
        simulate = _simulator(env, agent, params, trocars, settings, layout._replace(lanes=lanes))
        known = {(r["trocar"], r["trial"]): r["success"] for r in records.values()}

        def commit(episode: episodes.Episode) -> store.Record:
            outcome = episode.outcome
            key = store.key(*episode.trial, settings.seed)
            _require_finite(env.task, episode)
            kept = outcome["success"] or settings.keep_failures
            return store.commit(root, key, outcome, episode.arrays if kept else {})

        def note(record: store.Record) -> None:
            records[record["key"]] = record
            advance(int(record["success"]))

        def news() -> dict[episodes.Trial, bool]:
            """Reads episodes that other processes have written."""
            if share.count == 1:
                return {}
            found = _records(root, set(store.keys(root)) - records.keys() - written)
            for record in found.values():
                note(record)
            return {(r["trocar"], r["trial"]): r["success"] for r in found.values()}

        written: set[str] = set()  # by this process, but for those that `records` has
        needed = success_quota.run(
            simulate,
            known,
            len(trocars.radius),
            settings.per_trocar,
            lanes,
            max_workers,
            share,
            news,
        )
        with _shown(share, total, records) as advance, _writer(commit, note, lanes) as write:
            for episode in needed:
                written.add(store.key(*episode.trial, settings.seed))
                write(episode)
        share.meet("written")
        records |= _records(root, set(store.keys(root)) - records.keys())
        digest = share.first("sealed", lambda: store.seal(root, records))
    return {
        "digest": digest,
        "episodes": sum(record["success"] for record in records.values()),
        "trials": len(records),
        "frames": sum(record["length"] for record in records.values() if record["files"]),
    }


def precompile(
    env: Env, agent: BatchAgent, trocars: Trocar, settings: DemoSettings, params: Any = None
) -> None:
    """Compiles, in the background, the programs that `collect` runs on one device."""
    trocars = configurations.listed(trocars, len(env.p_world_ref))
    total = settings.per_trocar * len(trocars.radius)
    frame_bytes = schema.frame_bytes(schema.features(env))
    rules = _rules(settings, _lanes(DEFAULT_LAYOUT, total, frame_bytes, 1))
    engine.precompile(env, agent, params, trocars, rules, episodes.DEMONSTRATION)


def rows(demos: int, max_steps: int) -> int:
    """Returns the frames that a dataset of so many demonstrations has room for."""
    return windows.padded_count(demos * min(max_steps, FRAME_GUESS))


def _rules(settings: DemoSettings, lanes: int) -> engine.RolloutSettings:
    return engine.RolloutSettings(settings.seed, schema.STREAM, settings.max_steps, lanes)


def _prepare(
    root: Path,
    description: dict[str, Any],
    settings: DemoSettings,
    total: int,
    report: Callable[[str], None],
) -> None:
    """Leaves only sound episodes of this dataset in its folder, and sees whether the rest fits."""
    store.create(root, description)
    store.clean(root)
    done = _check_episodes(root, settings.seed, report)
    guess = min(settings.max_steps, FRAME_GUESS) * schema.frame_bytes(description["features"])
    files.require_writable(root, max(total - done, 0) * guess)


def _records(root: Path, keys: Iterable[str]) -> dict[str, store.Record]:
    """Records of sound episodes."""
    return {key: store.verify(root, key, arrays=False) for key in keys}


def _shown(
    share: sharing.Share, total: int, records: dict[str, store.Record]
) -> contextlib.AbstractContextManager[Any]:
    """Shows the progress of all processes on the first one."""
    if not share.is_first:
        return contextlib.nullcontext(lambda count: None)
    done = sum(record["success"] for record in records.values())
    return progress.track("Demonstrations", total, unit="episodes", done=done)


def _require_finite(task: Task, episode: episodes.Episode) -> None:
    """Raises UsageError for a task's state that is not finite; it names the field."""
    if "state" not in episode.arrays or np.isfinite(state := episode.joined("state")).all():
        return
    parts = np.split(state, np.cumsum([field.size for field in task.fields])[:-1], axis=1)
    names = [f.name for f, part in zip(task.fields, parts) if not np.isfinite(part).all()]
    trocar, trial = episode.trial
    raise errors.UsageError(
        f"task {task.name}: state",
        "finite numbers",
        f"others in {', '.join(names)} of trial {trial} at trocar {trocar}",
        f"starjax check {task.name}",
    )


def _simulator(
    env: Env,
    agent: BatchAgent,
    params: Any,
    trocars: Trocar,
    settings: DemoSettings,
    layout: DeviceLayout,
) -> Callable[[list[episodes.Trial]], Generator[list[episodes.Episode]]]:
    rules = _rules(settings, layout.lanes)
    run = engine.make(env, agent, trocars, rules, episodes.DEMONSTRATION, layout.devices)

    def simulate(group: list[episodes.Trial]) -> Generator[list[episodes.Episode]]:
        for segment in run(params, group):
            yield segment.ended

    return simulate


def _check_episodes(root: Path, seed: int, report: Callable[[str], None]) -> int:
    """Removes damaged episodes, to be collected again; returns how many successes there are.

    Raises:
      StorageError: one is of another seed, so that a lost dataset.json was of another dataset.
    """
    successes = 0
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
            successes += found["success"]
    return successes


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


def _fitting(frame_bytes: int) -> int:
    """Returns the episodes whose images fit in memory twice: while simulated and while written."""
    return int(MEMORY_SHARE * xla.memory_bytes() // (2 * FRAME_GUESS * frame_bytes))


def _lanes(layout: DeviceLayout, total: int, frame_bytes: int, processes: int) -> int:
    """Returns the lanes of a chunk."""
    fast = _fast(layout.devices, total, processes)
    lanes = layout.lanes or max(1, min(fast, _fitting(frame_bytes)))
    several = len(layout.devices or [0])
    return -(-lanes // several) * several


def _fast(devices: Sequence[jax.Device] | None, total: int, processes: int) -> int:
    """Returns the episodes per process at which a program is fastest, of `total` in all.

    Several GPUs share the load of one. Finished episodes do not change it: the size of a batch may
    change last bits.
    """
    if jax.default_backend() == "cpu":
        return workers.CPU_LANES
    count = len(devices or [0]) * processes
    return -(-GPU_LANES * min(count, -(-total // GPU_LANES)) // processes)
