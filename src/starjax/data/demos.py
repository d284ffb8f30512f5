"""Collects demonstrations: the expert in every trocar, as one program over (trocar, trial).

What ends up on disk is a function of the description, the seed and, in the last bits, the size of
the batch, which a machine's memory and devices decide: of each trocar, all trials up to the one
that completes its successes. They are drawn in waves, at first `per_trocar` at each trocar, then as
many as failed; lanes that a wave leaves free run the trials that come next, and those of them that
were not needed are dropped. A wave's chunks are the same in every run, and a chunk with a missing
episode is simulated again as a whole: after any interruption the same command on the same machine
ends in the same bytes.

Episodes are written as they end, while the rest of their chunk and the next are simulated.
"""

import collections
import concurrent.futures
import contextlib
import hashlib
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from starjax import rcm
from starjax.data import store
from starjax.rcm.trocar import Trocar
from starjax.rollouts import chunks, cores, episodes, recording
from starjax.runtime import files, jax_settings, progress, xla

COMMITS = 16  # episodes written at once; most of it is waiting for the disk
FRAME_GUESS = 300  # control steps of a typical demonstration, for estimates of disk and memory
MEMORY_SHARE = 0.25  # of the host's, for pictures of the episodes that are simulated together
GPU_LANES = 256  # episodes a GPU simulates together


def describe(
    env: Any,
    trocars: Trocar,
    *,
    per_trocar: int,
    seed: int,
    max_steps: int,
    keep_failures: bool = False,
    one_wall: bool = False,
) -> dict[str, Any]:
    """What a dataset is: the content of dataset.json, and by `store.digest` its name."""
    frame = recording.frame(env)
    features = {
        name: {
            "shape": list(leaf.shape),
            "dtype": np.dtype(leaf.dtype).str,
            "what": recording.FIELDS[name],
        }
        for name, leaf in frame.items()
    }
    return {
        "seed": seed,
        "per_trocar": per_trocar,
        "max_steps": max_steps,
        "keep_failures": keep_failures,
        "trocars": np.stack([np.asarray(f, np.float64) for f in trocars], -1).tolist(),
        "p_world_ref": np.asarray(env.p_world_ref, np.float64).tolist(),
        "control_hz": env.control_hz,
        "features": features,
        "scene": scene_hash(env.model),
        "seed_rule": f"fold_in(fold_in(fold_in(key(seed), {recording.STREAM}), trocar), trial)",
        "versions": xla.versions(),
        **jax_settings.record(),
        **({"one_wall": True} if one_wall else {}),  # not in the names of datasets without
    }


def collect(
    root: Path,
    env: Any,
    expert: Any,
    trocars: Trocar,
    *,
    per_trocar: int,
    seed: int,
    max_steps: int,
    keep_failures: bool = False,
    one_wall: bool = False,
    chunk: int = 0,
    devices: Sequence[jax.Device] | None = None,
    report: Callable[[str], None] = print,
) -> dict[str, Any]:
    """Collects what is missing of a dataset, and seals it.

    Args:
      root: folder of the dataset.
      env: `sim.env.Env`; its observation decides whether pictures or task states are stored.
      expert: has the functions of `recorder.Expert`.
      trocars: fields `[C]`.
      per_trocar: successful episodes wanted at each.
      max_steps: control steps after which an episode has failed.
      keep_failures: store failed episodes too.
      one_wall: what the description says of the expert.
      chunk: episodes simulated together; 0 for what suits the machine. On a CPU each of its cores
        has so many of its own.
      devices: to split a chunk over.
      report: gets lines for the user.

    Returns:
      {"digest", "episodes", "trials", "frames"}: the dataset's hash, successes kept, trials drawn
      for them, frames stored.

    Raises:
      StorageError: the folder cannot be read or written, is in use, holds another dataset, or is
        too small.
      ValueError: an argument out of range, a trocar that is none, an expert that fails too often.
    """
    if per_trocar < 1 or max_steps < 1 or chunk < 0:
        got = {"per_trocar": per_trocar, "max_steps": max_steps, "chunk": chunk}
        raise ValueError(f"per_trocar, max_steps: expected 1 or more, chunk: 0 or more, got {got}")
    trocars = listed(trocars)
    total = per_trocar * len(trocars.radius)
    with files.lock(root):
        frame = recording.frame(env)
        frame_bytes = sum(math.prod(x.shape) * x.dtype.itemsize for x in frame.values())
        description = describe(
            env,
            trocars,
            per_trocar=per_trocar,
            seed=seed,
            max_steps=max_steps,
            keep_failures=keep_failures,
            one_wall=one_wall,
        )
        store.create(root, description)
        store.clean(root)
        records = _sound(root, seed, report)
        done = sum(r["success"] for r in records.values())
        files.require_writable(
            root, max(total - done, 0) * min(max_steps, FRAME_GUESS) * frame_bytes
        )
        fits = int(MEMORY_SHARE * xla.memory_bytes() // (2 * FRAME_GUESS * frame_bytes))
        chunk = chunk or max(1, min(_fast(devices, total), fits))
        at_once = max(1, min(cores.count(), fits // chunk))
        chunk = -(-chunk // len(devices or [0])) * len(devices or [0])
        simulate = recording.simulator(env, expert, trocars, seed, max_steps, chunk, devices)
        known = {(r["trocar"], r["trial"]): r["success"] for r in records.values()}

        def commit(episode: episodes.Episode) -> store.Record:
            outcome = episode.outcome
            key = store.key(outcome["trocar"], outcome["trial"], seed)
            kept = outcome["success"] or keep_failures
            return store.commit(root, key, outcome, episode.arrays if kept else {})

        def note(record: store.Record) -> None:
            records[record["key"]] = record
            advance(int(record["success"]))

        needed = chunks.run(simulate, known, len(trocars.radius), per_trocar, chunk, at_once)
        shown = progress.track("Demonstrations", total, unit="episodes", done=done)
        with shown as advance, _writer(commit, note, chunk) as write:
            for episode in needed:
                write(episode)
        digest = store.seal(root, records)
    return {
        "digest": digest,
        "episodes": sum(record["success"] for record in records.values()),
        "trials": len(records),
        "frames": sum(record["length"] for record in records.values() if record["files"]),
    }


def listed(trocars: Trocar) -> Trocar:
    """Concrete trocars as float32 fields `[C]`.

    Raises:
      ValueError: one is none, there are none, or they have more axes than one.
    """
    rcm.check_trocar(trocars)
    fields = (np.atleast_1d(np.asarray(field, np.float32)) for field in trocars)
    trocars = Trocar(*np.broadcast_arrays(*fields))
    if trocars.radius.ndim != 1 or not trocars.radius.size:
        got = list(trocars.radius.shape)
        raise ValueError(f"trocars: expected fields [C] of one trocar or more, got shape {got}")
    return trocars


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


def _fast(devices: Sequence[jax.Device] | None, total: int) -> int:
    """Episodes that make the most of a program, where `total` are wanted: several GPUs share what
    one would do alone. Not of what is there already, as the size of a batch may change last bits.
    """
    if jax.default_backend() == "cpu":
        return cores.CPU_LANES
    return GPU_LANES * min(len(devices or [0]), -(-total // GPU_LANES))


def scene_hash(model: Any) -> str:
    """Identifies the simulated scene; empty where the environment has no MuJoCo model."""
    mj_model = getattr(model, "mj_model", None)
    if mj_model is None:
        return ""
    import mujoco

    buffer = np.zeros(mujoco.mj_sizeModel(mj_model), np.uint8)
    mujoco.mj_saveModel(mj_model, None, buffer)
    return hashlib.sha256(buffer.tobytes()).hexdigest()
