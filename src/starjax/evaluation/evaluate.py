"""Evaluates a policy over all trocars x trials, chunk by chunk, going on where a run was killed.

<directory>/plan.json          what is being evaluated; other weights or settings start afresh
<directory>/chunk_<n>.npz      a `table.Table` of the chunk's trials; its recorded trials
<directory>/recorded.npz       trajectories of a few trials, for figures and the video
"""

import hashlib
import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from starjax.evaluation import recorded, rollout, table
from starjax.rcm.trocar import Trocar
from starjax.runtime import files, progress

# Trials at once: a CPU is busy with 32; a GPU takes hundreds, as far as memory goes.
CPU_CHUNK, GPU_CHUNK, GPU_TRIAL_BYTES = 32, 1024, 32 << 20


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
      chunk: trials simulated at once; 0 for what suits the machine. Does not change the result.
      lanes: trials in one call of the network; 0 for `rollout.POLICY_LANES`. May change last bits.
      video_trials: how many trials get their joint positions recorded, at least.
      devices: to split a chunk over. Does not change the result.
      identity: JSON values that tell this policy from others with the same weights.
      report: gets lines for the user.

    Raises:
      StorageError: the folder cannot be written or is in use.
      ValueError: an argument out of range.
    """
    if trials < 1 or time_limit_s <= 0 or chunk < 0 or video_trials < 0:
        raise ValueError(
            "trials, time_limit_s: expected more than 0, chunk, video_trials: 0 or more, "
            f"got {trials}, {time_limit_s}, {chunk}, {video_trials}"
        )
    trocars = Trocar(*(np.asarray(field, np.float32).reshape(-1) for field in trocars))
    settings = rollout.Settings(
        obs_horizon=obs_horizon,
        execute=execute,
        max_steps=math.ceil(time_limit_s * env.control_hz - 1e-6),
        lanes=lanes or rollout.POLICY_LANES.get(jax.default_backend(), 128),
    )
    count = len(trocars.radius)
    index, trial = (x.reshape(-1) for x in np.divmod(np.arange(count * trials), trials))
    chosen = recorded.choose(count, trials, video_trials)
    with files.lock(directory):
        plan = {
            "seed": seed,
            "trials": trials,
            "trocars": np.stack(trocars, -1).astype(float).tolist(),
            **settings._asdict(),
            "recorded": int(chosen.sum()),
            "weights": fingerprint((params, normalizer)),
            "identity": dict(identity or {}),
        }
        chunk = _resume(directory, plan, chunk, len(index), devices, report)
        run = rollout.make(env, policy, settings, seed, devices)
        tables, kept = [], []
        with progress.track("Evaluation", len(index), unit="trials") as advance:
            for number, first in enumerate(range(0, len(index), chunk)):
                rows = slice(first, min(first + chunk, len(index)))
                path = directory / f"chunk_{number:04d}.npz"
                found = _read(path, report)
                if found is None:
                    here = _fill(trocars, index[rows], trial[rows], chunk)
                    told = _Told(advance, rows.stop - rows.start)
                    done = run(params, normalizer, here, told)
                    found = (
                        table.from_rollouts(done, index[rows], trial[rows]),
                        recorded.take(done, here, chosen[rows], env.p_world_ref),
                    )
                    _write(path, *found)
                    told(1.0)
                else:
                    advance(rows.stop - rows.start)
                tables.append(found[0])
                kept.append(found[1])
        if chosen.any():
            files.write_npz(directory / "recorded.npz", recorded.join(kept))
    return table.join(tables)


def fingerprint(tree: Any) -> str:
    """SHA-256 of all arrays of a pytree and of their places in it."""
    digest = hashlib.sha256()
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        array = np.asarray(leaf)
        digest.update(f"{jax.tree_util.keystr(path)} {array.dtype} {array.shape} ".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


class _Told:
    """Turns a chunk's share of time into trials of the progress bar."""

    def __init__(self, advance: Callable[..., None], count: int):
        self._advance, self._count, self._shown = advance, count, 0.0

    def __call__(self, fraction: float) -> None:
        self._advance((fraction - self._shown) * self._count)
        self._shown = fraction


def _resume(
    directory: Path,
    plan: dict[str, Any],
    chunk: int,
    total: int,
    devices: Sequence[jax.Device] | None,
    report: Callable[[str], None],
) -> int:
    """Keeps the chunks of an earlier run of the same plan, removes others; returns the chunk."""
    path = directory / "plan.json"
    found = json.loads(path.read_text()) if path.exists() else {}
    same = {k: v for k, v in found.items() if k != "chunk"} == json.loads(json.dumps(plan))
    per = len(devices or [0])
    if same and chunk in (0, found["chunk"]) and found["chunk"] % per == 0:
        return found["chunk"]
    old = sorted(directory.glob("chunk_*.npz"))
    if old:
        report(f"{directory}: {len(old)} chunks of another evaluation are replaced")
    for file in [path, directory / "recorded.npz", *old]:
        file.unlink(missing_ok=True)
    even = chunk or -(-total // -(-total // _most(devices)))
    chunk = -(-even // per) * per
    files.write_json(path, {**plan, "chunk": chunk})
    return chunk


def _most(devices: Sequence[jax.Device] | None) -> int:
    if jax.default_backend() == "cpu":
        return CPU_CHUNK
    chosen = list(devices or jax.devices()[:1])
    stats = chosen[0].memory_stats() or {}
    free = stats.get("bytes_limit", 8 << 30) - stats.get("bytes_in_use", 0)
    return len(chosen) * max(1, min(GPU_CHUNK, int(0.5 * free) // GPU_TRIAL_BYTES))


def _fill(trocars: Trocar, index: np.ndarray, trial: np.ndarray, chunk: int) -> rollout.Trials:
    """A full chunk: the first trial repeats, unwanted, where there are too few."""
    count = len(index)
    rows = np.where(np.arange(chunk) < count, np.arange(chunk) % count, 0)
    return rollout.Trials(
        trocar=Trocar(*(field[index[rows]] for field in trocars)),
        index=index[rows].astype(np.int32),
        trial=trial[rows].astype(np.int32),
        wanted=np.arange(chunk) < count,
    )


def _write(path: Path, rows: table.Table, kept: dict[str, np.ndarray]) -> None:
    files.write_npz(
        path, {**rows._asdict(), **{f"recorded.{name}": value for name, value in kept.items()}}
    )


def _read(
    path: Path, report: Callable[[str], None]
) -> tuple[table.Table, dict[str, np.ndarray]] | None:
    """A finished chunk, or None if it is missing or damaged (the archive has checksums)."""
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as archive:
            arrays = dict(archive)
        rows = table.Table(**{name: arrays.pop(name) for name in table.Table._fields})
    except FileNotFoundError:
        return None
    except Exception as error:  # a damaged archive fails in a dozen ways
        report(f"damaged, evaluated again: {path}: {error}")
        return None
    return rows, {name.removeprefix("recorded."): value for name, value in arrays.items()}
