"""Evaluates an agent over all trocars x trials, chunk by chunk, going on where a run was killed.

<directory>/plan.json          what is being evaluated; other weights, settings, scenes or versions
                               start afresh
<directory>/chunk_<n>.npz      a `trials.Table` of the chunk's trials; its recorded trials
<directory>/recorded.npz       trajectories of a few trials, for figures and the video
"""

import hashlib
import json
import math
from collections.abc import Callable, Generator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from starjax import errors
from starjax.data import schema
from starjax.evaluation import recorded
from starjax.evaluation import trials as tables
from starjax.rcm.trocar import Trocar
from starjax.rollouts import cores, engine, episodes
from starjax.rollouts import trocars as configurations
from starjax.rollouts.agent import BatchAgent
from starjax.rollouts.placement import ANYWHERE, Place
from starjax.runtime import files, jax_settings, progress, xla

# Trials together on a GPU, which takes hundreds in the time of one, as far as its memory goes.
GPU_LANES, SMALL_GPU_LANES, SMALL_GPU_BYTES = 1280, 128, 40 << 30

_RECORDED = "recorded."


class Settings(NamedTuple):
    """Which trials are run.

    Attributes:
      trials: at each configuration of trocars.
      seed: decides every trial's start and noise; methods with the same seed meet the same trials.
      time_limit_s: of a trial, simulated.
      video_trials: how many trials get their joint positions recorded, at least.
      chunk: trials that are simulated and saved together, at most; 0 for as many as the lanes.
        Changes neither the result nor the memory taken.
    """

    trials: int
    seed: int
    time_limit_s: float = 60.0
    video_trials: int = 0
    chunk: int = 0


def evaluate(
    directory: Path,
    env: Any,
    agent: BatchAgent,
    params: Any,
    trocars: Trocar,
    settings: Settings,
    *,
    place: Place = ANYWHERE,
    identity: Mapping[str, Any] | None = None,
    report: Callable[[str], None] = print,
) -> tables.Table:
    """Runs what is missing of an evaluation and returns all of it.

    Args:
      directory: folder of this evaluation alone.
      env: `sim.env.Env`, with the observation that the agent knows.
      params: of the agent: a policy's (weights, statistics).
      trocars: fields `[C, A]`.
      place: where the lanes are 0, `lanes_per_device`, and so few that all devices have a share.
      identity: JSON values that tell this agent from others with the same params.
      report: gets lines for the user.

    Raises:
      StorageError: the folder cannot be written or is in use.
      ValueError: an argument out of range, a trocar that is none.
    """
    _check(settings, place)
    trocars = configurations.listed(trocars, len(env.p_world_ref))
    count = len(trocars.radius)
    group = [(i, trial) for i in range(count) for trial in range(settings.trials)]
    several = len(place.devices or [0])
    first_device = (place.devices or jax.local_devices())[0]
    lanes = place.lanes or lanes_per_device(first_device, -(-len(group) // several))
    batch = lanes * several
    max_steps = math.ceil(settings.time_limit_s * env.control_hz - 1e-6)
    rules = engine.Settings(settings.seed, None, max_steps, batch)
    run = engine.make(env, agent, trocars, rules, episodes.SCORE, place.devices)
    chosen = recorded.choose(count, settings.trials, settings.video_trials)
    with files.lock(directory):
        plan = {
            "seed": settings.seed,
            "trials": settings.trials,
            "trocars": np.stack(trocars, -1).astype(float).tolist(),
            "max_steps": max_steps,
            "lanes": lanes,
            "recorded": int(chosen.sum()),
            "weights": fingerprint(params),
            "agent": agent.about,
            "identity": dict(identity or {}),
            "scene": env.names._asdict(),
            "model": schema.model_hash(env.scene),
            "versions": xla.versions(),
            **jax_settings.record(),
        }
        chunk = _resume(directory, plan, min(settings.chunk or batch, batch), batch, report)
        spans = [slice(first, first + chunk) for first in range(0, len(group), chunk)]
        paths = [directory / f"chunk_{number:04d}.npz" for number in range(len(spans))]
        labels = env.task.labels
        beside = [f"{_RECORDED}{name}" for name in recorded.names(labels)]
        chunks = [
            _read(
                path,
                group[rows],
                tables.names(labels) + (beside if chosen[rows].any() else []),
                report,
            )
            for path, rows in zip(paths, spans, strict=True)
        ]
        missing = [number for number, found in enumerate(chunks) if found is None]
        done = len(group) - sum(len(group[spans[number]]) for number in missing)

        def simulate(number: int) -> Generator[float]:
            """Makes a chunk; yields how many trials, or parts of them, have passed in between."""
            here, passed, ended = group[spans[number]], 0.0, []
            for segment in run(params, here):
                ended += segment.ended
                yield (segment.passed - passed) * len(here)
                passed = segment.passed
            ended.sort(key=lambda episode: episode.trial)
            kept = [e for e, keep in zip(ended, chosen[spans[number]], strict=True) if keep]
            made = tables.from_episodes(ended), recorded.take(kept, env.p_world_ref)
            _write(paths[number], *made)
            chunks[number] = made

        with progress.track("Evaluation", len(group), unit="trials", done=done) as advance:
            for passed in cores.run(missing, simulate, cores.count()):
                advance(passed)
        found, kept = zip(*chunks, strict=True)
        if chosen.any():
            files.write_npz(directory / "recorded.npz", recorded.join(kept))
    return tables.join(found)


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


def _check(settings: Settings, place: Place) -> None:
    for name, value in (("trials", settings.trials), ("time_limit_s", settings.time_limit_s)):
        if value <= 0:
            raise errors.UsageError(name, "more than 0", value)
    counts = {"video_trials": settings.video_trials, "chunk": settings.chunk, "lanes": place.lanes}
    for name, value in counts.items():
        if value < 0:
            raise errors.UsageError(name, "0 or more", value)


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


def _write(path: Path, table: tables.Table, kept: dict[str, np.ndarray]) -> None:
    beside = {f"{_RECORDED}{name}": value for name, value in kept.items()}
    files.write_npz(path, tables.columns(table) | beside)


def _read(
    path: Path,
    group: list[episodes.Trial],
    names: list[str],
    report: Callable[[str], None],
) -> tuple[tables.Table, dict[str, np.ndarray]] | None:
    """A finished chunk, or None if it is missing, damaged or of other trials than these."""
    try:
        arrays = files.read_npz(path, names)
    except FileNotFoundError:
        return None
    except ValueError as error:
        report(f"{error}; evaluated again")
        return None
    table = tables.from_columns(arrays)
    if list(zip(table.trocar.tolist(), table.trial.tolist(), strict=True)) != group:
        report(f"{path} holds other trials; evaluated again")
        return None
    kept = {
        name.removeprefix(_RECORDED): value
        for name, value in arrays.items()
        if name.startswith(_RECORDED)
    }
    return table, kept
