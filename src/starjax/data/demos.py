"""Collects demonstrations: the expert in every trocar, as one program over (trocar, trial).

What ends up on disk is a function of the description and the seed alone. Trials are drawn in waves:
`per_trocar` at each trocar, then as many as failed, until every trocar has its successes; so the
first successes by trial number are kept, whatever the chunk. A wave's chunks are the same in every
run, and a chunk with a missing episode is simulated again as a whole: after any interruption the
same command ends in the same bytes.
"""

import concurrent.futures
import hashlib
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from starjax.data import recorder, store
from starjax.rcm.trocar import Trocar
from starjax.runtime import files, progress, xla

MIN_SUCCESS_RATE = 0.5  # below it at some trocar, the expert is broken and collecting stops
COMMITS = 8  # episodes written at once
FRAME_GUESS = 300  # control steps of a typical demonstration, for the estimate of disk space


def describe(
    env: Any,
    trocars: Trocar,
    *,
    per_trocar: int,
    seed: int,
    max_steps: int,
    keep_failures: bool = False,
) -> dict[str, Any]:
    """What a dataset is: the content of dataset.json, and by `store.digest` its name."""
    frame = recorder.frame(env)
    features = {
        name: {
            "shape": list(leaf.shape),
            "dtype": np.dtype(leaf.dtype).str,
            "what": recorder.FIELDS[name],
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
        "scene": _scene_hash(env.model),
        "seed_rule": f"fold_in(fold_in(fold_in(key(seed), {recorder.STREAM}), trocar), trial)",
        "versions": xla.versions(),
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
      chunk: episodes simulated at once; 0 for what suits the machine.
      devices: to split a chunk over.
      report: gets lines for the user.

    Returns:
      {"digest", "episodes", "trials", "frames"}: the dataset's hash, successes kept, trials drawn
      for them, frames stored.

    Raises:
      StorageError: the folder cannot be written, is in use, holds another dataset, or is too small.
      ValueError: an argument out of range, or an expert that fails too often.
    """
    if per_trocar < 1 or max_steps < 1 or chunk < 0:
        got = {"per_trocar": per_trocar, "max_steps": max_steps, "chunk": chunk}
        raise ValueError(f"per_trocar, max_steps: expected 1 or more, chunk: 0 or more, got {got}")
    trocars = Trocar(*(np.asarray(field, np.float32) for field in trocars))
    total = per_trocar * len(trocars.radius)
    with files.lock(root):
        frame = recorder.frame(env)
        frame_bytes = sum(math.prod(x.shape) * x.dtype.itemsize for x in frame.values())
        description = describe(
            env,
            trocars,
            per_trocar=per_trocar,
            seed=seed,
            max_steps=max_steps,
            keep_failures=keep_failures,
        )
        store.create(root, description)
        store.clean(root)
        records = _sound(root, report)
        done = sum(r["success"] for r in records.values())
        files.require_writable(
            root, max(total - done, 0) * min(max_steps, FRAME_GUESS) * frame_bytes
        )
        chunk = chunk or _chunk(frame_bytes, devices)
        chunk = -(-chunk // len(devices or [0])) * len(devices or [0])
        simulate = recorder.simulator(env, expert, trocars, seed, max_steps, chunk, devices)
        shown = progress.track("Demonstrations", total, unit="episodes", done=done)
        with shown as advance, concurrent.futures.ThreadPoolExecutor(COMMITS) as pool:
            drawn = np.zeros(len(trocars.radius), int)
            while wave := _wave(records, drawn, per_trocar, seed):
                for group in (wave[i : i + chunk] for i in range(0, len(wave), chunk)):
                    missing = [i for i, t in enumerate(group) if store.key(*t, seed) not in records]
                    if not missing:
                        continue
                    episode = simulate(group)

                    def commit(lane: int, episode=episode) -> store.Record:
                        outcome, arrays = episode(lane)
                        key = store.key(outcome["trocar"], outcome["trial"], seed)
                        kept = outcome["success"] or keep_failures
                        return store.commit(root, key, outcome, arrays if kept else {})

                    # In threads: most of a commit is waiting for the disk.
                    for record in pool.map(commit, missing):
                        records[record["key"]] = record
                        advance(int(record["success"]))
        digest = store.seal(root, records)
    return {
        "digest": digest,
        "episodes": sum(record["success"] for record in records.values()),
        "trials": len(records),
        "frames": sum(record["length"] for record in records.values() if record["files"]),
    }


def _sound(root: Path, report: Callable[[str], None]) -> dict[str, store.Record]:
    """Records of the episodes on disk; damaged ones are removed, to be collected again."""
    records = {}
    for key, found in store.verify_all(root, store.keys(root)).items():
        if isinstance(found, store.DamagedEpisode):
            report(f"damaged, collected again: {found}")
            (root / "SEALED.json").unlink(missing_ok=True)
            store.remove(root, key)
        else:
            records[key] = found
    return records


def _wave(
    records: dict[str, store.Record], drawn: np.ndarray, per_trocar: int, seed: int
) -> list[tuple[int, int]]:
    """Next trials (trocar, trial): as many at each trocar as successes are missing there.

    Updates `drawn` `[C]`, the trials drawn so far at each trocar.
    """
    wave = []
    for trocar, first in enumerate(drawn.tolist()):
        done = [records[store.key(trocar, trial, seed)]["success"] for trial in range(first)]
        missing = per_trocar - sum(done)
        if missing and first >= 8 + per_trocar / MIN_SUCCESS_RATE:
            raise ValueError(
                f"expert: expected a success rate above {MIN_SUCCESS_RATE:.0%}, "
                f"got {sum(done)} of {first} at trocar {trocar}"
            )
        wave += [(trocar, first + i) for i in range(missing)]
        drawn[trocar] += missing
    return wave


def _chunk(frame_bytes: int, devices: Sequence[jax.Device] | None) -> int:
    """Episodes at once: 16 fill a CPU, a GPU takes hundreds; pictures of all must fit the host.

    A function of the machine alone, as the size of a batch may change last bits.
    """
    fast = 16 if jax.default_backend() == "cpu" else 256 * len(devices or [0])
    fits = int(0.25 * xla.memory_bytes() // (2 * FRAME_GUESS * frame_bytes))
    return max(1, min(fast, fits))


def _scene_hash(model: Any) -> str:
    """Identifies the simulated scene; empty where the environment has no MuJoCo model."""
    mj_model = getattr(model, "mj_model", None)
    if mj_model is None:
        return ""
    import mujoco

    buffer = np.zeros(mujoco.mj_sizeModel(mj_model), np.uint8)
    mujoco.mj_saveModel(mj_model, None, buffer)
    return hashlib.sha256(buffer.tobytes()).hexdigest()
