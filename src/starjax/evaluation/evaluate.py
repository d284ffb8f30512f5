"""Evaluates a policy over all trocars x trials, chunk by chunk, going on where a run was killed.

<directory>/plan.json          what is being evaluated; other weights, settings, scenes or versions
                               start afresh
<directory>/chunk_<n>.npz      a `table.Table` of the chunk's trials; its recorded trials
<directory>/recorded.npz       trajectories of a few trials, for figures and the video
"""

import hashlib
import json
import math
from collections.abc import Callable, Generator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from starjax.data import demos
from starjax.evaluation import recorded
from starjax.evaluation import trials as table
from starjax.rcm.trocar import Trocar
from starjax.rollouts import cores, engine
from starjax.runtime import files, jax_settings, progress, xla

# Trials together on a GPU, which takes hundreds in the time of one, as far as its memory goes.
GPU_LANES, SMALL_GPU_LANES, SMALL_GPU_BYTES = 1280, 128, 40 << 30


def evaluate(
    directory: Path,
    env: Any,
    policy: Any,
    params: Any,
    normalizer: Any,
    trocars: Trocar,
    *,
    trials: int,
    seed: int,
    obs_horizon: int,
    execute: int,
    time_limit_s: float = 60.0,
    chunk: int = 0,
    lanes: int = 0,
    video_trials: int = 0,
    devices: Sequence[jax.Device] | None = None,
    identity: Mapping[str, Any] | None = None,
    report: Callable[[str], None] = print,
) -> table.Table:
    """Runs what is missing of an evaluation and returns all of it.

    Args:
      directory: folder of this evaluation alone.
      env: `sim.env.Env`, with the observation that the policy was trained on.
      policy: `policies.policy.Policy`.
      params: its weights (EMA).
      normalizer: its statistics.
      trocars: fields `[C]`.
      trials: at each trocar.
      seed: decides every trial's start and noise; methods with the same seed meet the same trials.
      obs_horizon: observations the policy sees.
      execute: commands executed before re-planning.
      time_limit_s: of a trial, simulated.
      chunk: trials that are simulated and saved together, at most; 0 for as many as the lanes.
        Changes neither the result nor the memory taken.
      lanes: size of the compiled batch on each device, or of each core's on a CPU; 0 for
        `lanes_per_device`: it is what decides memory, and may change last bits.
      video_trials: how many trials get their joint positions recorded, at least.
      devices: to split a chunk over; where `lanes` is 0, these are so few that all have a share.
      identity: JSON values that tell this policy from others with the same weights.
      report: gets lines for the user.

    Raises:
      StorageError: the folder cannot be written or is in use.
      ValueError: an argument out of range, a trocar that is none.
    """
    if trials < 1 or time_limit_s <= 0 or min(chunk, lanes, video_trials) < 0:
        raise ValueError(
            "trials, time_limit_s: expected more than 0, chunk, lanes, video_trials: 0 or more, "
            f"got {trials}, {time_limit_s}, {chunk}, {lanes}, {video_trials}"
        )
    trocars = demos.listed(trocars)
    settings = engine.Settings(
        obs_horizon=obs_horizon,
        execute=execute,
        max_steps=math.ceil(time_limit_s * env.control_hz - 1e-6),
    )
    run = engine.make(env, policy, settings, seed, devices)
    count = len(trocars.radius)
    first_device = (devices or jax.local_devices())[0]
    several = len(devices or [0])
    lanes = lanes or lanes_per_device(first_device, -(-count * trials // several))
    batch = lanes * several
    index, trial = (x.reshape(-1) for x in np.divmod(np.arange(count * trials), trials))
    chosen = recorded.choose(count, trials, video_trials)
    with files.lock(directory):
        plan = {
            "seed": seed,
            "trials": trials,
            "trocars": np.stack(trocars, -1).astype(float).tolist(),
            **settings._asdict(),
            "lanes": lanes,
            "recorded": int(chosen.sum()),
            "weights": fingerprint((params, normalizer)),
            "identity": dict(identity or {}),
            "scene": demos.scene_hash(env.model),
            "versions": xla.versions(),
            **jax_settings.record(),
        }
        chunk = _resume(directory, plan, min(chunk or batch, batch), batch, report)
        spans = [
            slice(first, min(first + chunk, len(index))) for first in range(0, len(index), chunk)
        ]
        paths = [directory / f"chunk_{number:04d}.npz" for number in range(len(spans))]
        chunks = [
            _read(path, index[rows], trial[rows], report)
            for path, rows in zip(paths, spans, strict=True)
        ]
        missing = [number for number, found in enumerate(chunks) if found is None]
        done = len(index) - sum(spans[number].stop - spans[number].start for number in missing)

        def simulate(number: int) -> Generator[float]:
            """Makes a chunk; yields how many trials, or parts of them, have passed in between."""
            rows, shown = spans[number], 0.0
            here = _fill(trocars, index[rows], trial[rows], batch)
            for passed, rollouts in run(params, normalizer, here):
                if rollouts is not None:
                    made = (
                        table.from_rollouts(rollouts, index[rows], trial[rows]),
                        recorded.take(rollouts, here, chosen[rows], env.p_world_ref),
                    )
                    _write(paths[number], *made)
                    chunks[number] = made
                yield (passed - shown) * (rows.stop - rows.start)
                shown = passed

        with progress.track("Evaluation", len(index), unit="trials", done=done) as advance:
            for passed in cores.run(missing, simulate, cores.count()):
                advance(passed)
        tables, kept = zip(*chunks, strict=True)
        if chosen.any():
            files.write_npz(directory / "recorded.npz", recorded.join(kept))
    return table.join(tables)


def lanes_per_device(device: jax.Device, trials: int) -> int:
    """Trials that a device of this kind runs together, where its share of them are `trials`.

    A GPU's are as many as make the fewest chunks, and no more than these need.
    """
    if device.platform == "cpu":
        return cores.CPU_LANES
    limit = (device.memory_stats() or {}).get("bytes_limit", 0)
    most = GPU_LANES if limit >= SMALL_GPU_BYTES else SMALL_GPU_LANES
    chunks = -(-trials // most)
    return min(most, 8 * -(-trials // (8 * chunks)))


def fingerprint(tree: Any) -> str:
    """SHA-256 of all arrays of a pytree and of their places in it."""
    digest = hashlib.sha256()
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        array = np.asarray(leaf)
        digest.update(f"{jax.tree_util.keystr(path)} {array.dtype} {array.shape} ".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _resume(
    directory: Path,
    plan: dict[str, Any],
    chunk: int,
    batch: int,
    report: Callable[[str], None],
) -> int:
    """Keeps the chunks of an earlier run of the same plan, removes others; returns their size."""
    path = directory / "plan.json"
    try:
        found = files.read_json(path) if path.exists() else {}
    except ValueError as error:
        report(str(error))
        found = {}
    same = {k: v for k, v in found.items() if k != "chunk"} == json.loads(json.dumps(plan))
    if same and 1 <= found.get("chunk", 0) <= batch:
        return found["chunk"]
    old = len(list(directory.glob("chunk_*.npz")))
    if old:
        report(f"{directory}: {old} chunks of another evaluation are replaced")
    # The plan goes first: chunks without one belong to nothing.
    for file in [path, directory / "recorded.npz", *directory.glob("chunk_*.npz")]:
        file.unlink(missing_ok=True)
    files.write_json(path, {**plan, "chunk": chunk})
    return chunk


def _fill(trocars: Trocar, index: np.ndarray, trial: np.ndarray, batch: int) -> engine.Trials:
    """A full batch: the first trial repeats, unwanted, where there are too few."""
    count = len(index)
    rows = np.where(np.arange(batch) < count, np.arange(batch) % count, 0)
    return engine.Trials(
        trocar=Trocar(*(field[index[rows]] for field in trocars)),
        index=index[rows].astype(np.int32),
        trial=trial[rows].astype(np.int32),
        wanted=np.arange(batch) < count,
    )


def _write(path: Path, rows: table.Table, kept: dict[str, np.ndarray]) -> None:
    files.write_npz(
        path, {**rows._asdict(), **{f"recorded.{name}": value for name, value in kept.items()}}
    )


def _read(
    path: Path, index: np.ndarray, trial: np.ndarray, report: Callable[[str], None]
) -> tuple[table.Table, dict[str, np.ndarray]] | None:
    """A finished chunk, or None if it is missing, damaged or of other trials than these."""
    try:
        arrays = files.read_npz(path, table.Table._fields)
    except FileNotFoundError:
        return None
    except ValueError as error:
        report(f"{error}; evaluated again")
        return None
    rows = table.Table(**{name: arrays.pop(name) for name in table.Table._fields})
    if not (np.array_equal(rows.trocar, index) and np.array_equal(rows.trial, trial)):
        report(f"{path} holds other trials; evaluated again")
        return None
    return rows, {name.removeprefix("recorded."): value for name, value in arrays.items()}
