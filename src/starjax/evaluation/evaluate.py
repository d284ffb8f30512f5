"""Evaluates an agent over all trocars x trials in chunks; a killed run resumes.

Chunks are split over the processes of a run; each process has all trials at the end.

<directory>/plan.json          identity of the evaluation; other weights, settings, scenes or
                               versions replace the chunks
<directory>/chunk_<n>.npz      a `trials.Table` of the chunk's trials; its recorded trials
<directory>/recorded.npz       trajectories of a few trials, for figures and the video
<directory>/invalid.npz        those of all trials whose simulation diverged, if any, to replay
"""

import functools
import hashlib
import json
import math
from collections.abc import Callable, Generator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from starjax.core import errors, sources
from starjax.core.types import ArrayTree
from starjax.data import schema
from starjax.evaluation import alarms, recorded
from starjax.evaluation import trials as tables
from starjax.evaluation.disturbances import DISTURBANCES
from starjax.policies.monitor.scores import NAMES, ScoreSettings
from starjax.rcm.trocar import Trocar
from starjax.runtime import files, jax_settings, xla
from starjax.sim import endoscope_camera, registries
from starjax.sim.rollouts import chunks, engine, episodes, plans, sharing, workers
from starjax.sim.rollouts import trocars as configurations
from starjax.sim.rollouts.agent import BatchAgent
from starjax.sim.rollouts.placement import DEFAULT_LAYOUT, DeviceLayout
from starjax.sim.state import Env

# Trials together on a GPU, which takes hundreds in the time of one, as far as its memory goes.
GPU_LANES, SMALL_GPU_LANES, SMALL_GPU_BYTES = 1280, 128, 40 << 30

_RECORDED, _INVALID = "recorded.", "invalid."  # before columns of trajectories in a chunk
_FILES = {_RECORDED: "recorded.npz", _INVALID: "invalid.npz"}


class EvaluationSettings(NamedTuple):
    """Trials of an evaluation.

    Attributes:
      trials: at each configuration of trocars.
      seed: decides every trial's start and noise; methods with the same seed meet the same trials.
      time_limit_s: of a trial, simulated.
      video_trials: minimum number of trials with recorded joint positions.
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
    env: Env,
    agent: BatchAgent,
    params: Any,
    trocars: Trocar,
    settings: EvaluationSettings,
    *,
    layout: DeviceLayout = DEFAULT_LAYOUT,
    identity: Mapping[str, Any] | None = None,
    levels: Mapping[str, float] | None = None,
    score_settings: ScoreSettings | None = None,
    report: Callable[[str], None] = print,
) -> tables.Table:
    """Runs the missing chunks of an evaluation and returns all trials.

    Args:
      directory: folder of this evaluation alone.
      env: `sim.env.Env`, with the agent's observation type.
      params: of the agent: a policy's (weights, statistics).
      trocars: fields `[C, A]`.
      layout: lanes 0 stands for `lanes_per_device`, reduced until every device gets trials.
      identity: JSON values that tell this agent from others with the same params.
      levels: of the environment's disturbances.
      score_settings: of the runtime monitor, for the table's scores; None without them.
      report: gets lines for the user.

    Raises:
      StorageError: the folder cannot be written or is in use.
      ValueError: an argument out of range, an invalid trocar.
    """
    _check(settings, layout)
    trocars = configurations.listed(trocars, len(env.p_world_ref))
    count = len(trocars.radius)
    group = [(i, trial) for i in range(count) for trial in range(settings.trials)]
    max_steps = _max_steps(env, settings)
    chosen = recorded.choose(count, settings.trials, settings.video_trials)
    several = len(layout.devices or [0])
    device = (layout.devices or jax.local_devices())[0]
    wrong = {name: level for name, level in (levels or {}).items() if level}
    with sharing.shared(directory) as share:
        plan = {
            "seed": settings.seed,
            "trials": settings.trials,
            "trocars": np.stack(trocars, -1).astype(float).tolist(),
            "max_steps": max_steps,
            "recorded": int(chosen.sum()),
            "weights": fingerprint(params),
            "agent": agent.about,
            "identity": dict(identity or {}),
            # Levels of 0 are omitted: they leave the trials unchanged.
            **({"levels": wrong} if wrong else {}),
            **({"scores": {**score_settings._asdict(), "names": NAMES}} if score_settings else {}),
            "scene": env.names._asdict(),
            "model": schema.model_hash(env.scene),
            "platform": device.platform,
            **sources.record(
                [
                    *registries.parts(env.names),
                    *(sources.identity(DISTURBANCES, name) for name in wrong),
                ]
            ),
            "versions": xla.versions(),
            **jax_settings.record(),
        }
        each = -(-len(group) // (several * share.count))
        lanes = layout.lanes or lanes_per_device(device, each)
        batch = lanes * several
        sizes = {"lanes": lanes, "chunk": min(settings.chunk or batch, batch)}
        max_lanes = layout.lanes or most_lanes(device)
        lanes, chunk = share.first(
            "sizes", lambda: _resume(directory, plan, sizes, max_lanes, several, report)
        )
        rules = engine.RolloutSettings(settings.seed, None, max_steps, lanes * several)
        record = plans.record(score_settings.execute) if score_settings else episodes.SCORE
        run = engine.make(env, agent, trocars, rules, record, layout.devices, levels)
        spans = [slice(first, first + chunk) for first in range(0, len(group), chunk)]
        score = None
        if score_settings:
            score = functools.partial(
                alarms.of_episodes, settings=score_settings, max_steps=max_steps
            )
        simulate = lambda trials: run(params, trials)  # noqa: E731
        parts = _parts(directory, env, simulate, group, spans, chosen, score)
        made = chunks.complete(share, parts, "Evaluation", "trials", report)
        if share.is_first:
            _write_trajectories(directory, made)
    return tables.join([*map(tables.from_columns, made)])


def precompile(
    env: Env, agent: BatchAgent, params: Any, trocars: Trocar, settings: EvaluationSettings
) -> None:
    """Compiles, in the background, the programs that `evaluate` runs on one device.

    The arguments are those of `evaluate`; `params` are arrays or their shapes.
    """
    trocars = configurations.listed(trocars, len(env.p_world_ref))
    trials = len(trocars.radius) * settings.trials
    lanes = lanes_per_device(jax.local_devices()[0], trials)
    rules = engine.RolloutSettings(settings.seed, None, _max_steps(env, settings), lanes)
    engine.precompile(env, agent, params, trocars, rules, episodes.SCORE)


def lanes_per_device(device: jax.Device, trials: int) -> int:
    """Returns the number of trials that a device of this kind runs together, out of `trials`.

    A GPU's are as many as make the fewest chunks, and no more than these need.
    """
    most = most_lanes(device)
    if device.platform == "cpu":
        return most
    count = -(-trials // most)
    return min(most, 8 * -(-trials // (8 * count)))


def most_lanes(device: jax.Device) -> int:
    """Returns the maximum number of trials that a device of this kind runs together."""
    if device.platform == "cpu":
        return workers.CPU_LANES
    limit = (device.memory_stats() or {}).get("bytes_limit", 0)
    return GPU_LANES if limit >= SMALL_GPU_BYTES else SMALL_GPU_LANES


def fingerprint(tree: ArrayTree) -> str:
    """Returns the SHA-256 of all arrays of a pytree and of their paths in it."""
    digest = hashlib.sha256()
    for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
        array = np.asarray(leaf)
        digest.update(f"{jax.tree_util.keystr(path)} {array.dtype} {array.shape} ".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _max_steps(env: Env, settings: EvaluationSettings) -> int:
    return math.ceil(settings.time_limit_s * env.control_hz - 1e-6)


def _check(settings: EvaluationSettings, layout: DeviceLayout) -> None:
    for name, value in (("trials", settings.trials), ("time_limit_s", settings.time_limit_s)):
        if value <= 0:
            raise errors.UsageError(name, "more than 0", value)
    counts = {"video_trials": settings.video_trials, "chunk": settings.chunk, "lanes": layout.lanes}
    for name, value in counts.items():
        if value < 0:
            raise errors.UsageError(name, "0 or more", value)


def _resume(
    directory: Path,
    plan: dict[str, Any],
    sizes: dict[str, int],
    max_lanes: int,
    several: int,
    report: Callable[[str], None],
) -> list[int]:
    """Keeps the chunks of an earlier run of the same plan, whose sizes are kept too, where a device
    takes so many lanes; removes others. Returns lanes and chunk."""
    path = directory / "plan.json"
    try:
        previous = files.read_json(path) if path.exists() else {}
    except ValueError as error:
        report(str(error))
        previous = {}
    before = [previous.pop(name, 0) for name in sizes]
    fits = 1 <= before[0] <= max_lanes and 1 <= before[1] <= before[0] * several
    now = json.loads(json.dumps(plan))
    if fits and {**previous, "source": {}} == {**now, "source": {}}:
        sources.refuse_other_code(path, previous, now)
        return before
    old = len(list(directory.glob("chunk_*.npz")))
    if old:
        report(f"{directory}: {old} chunks of another evaluation are replaced")
    # The plan goes first: chunks without one belong to nothing.
    for file in [path, *map(directory.joinpath, _FILES.values()), *directory.glob("chunk_*.npz")]:
        file.unlink(missing_ok=True)
    files.write_json(path, {**plan, **sizes})
    return list(sizes.values())


def _parts(
    directory: Path,
    env: Env,
    run: Callable[..., Generator[engine.Progress]],
    group: list[episodes.Trial],
    spans: list[slice],
    chosen: np.ndarray,
    score: Callable[[list[episodes.Episode]], np.ndarray] | None = None,
) -> chunks.Parts:
    """Describes the chunks: tables, trajectories of the `chosen` `[M]` and the invalid trials."""
    names = tables.names(env.task.labels, has_scores=score is not None)
    labels = env.task.labels
    has_endoscope = endoscope_camera.of(env.task, env.names.cameras) is not None
    of_trajectories = recorded.names(labels, has_endoscope)

    def check(number: int, arrays: chunks.Arrays) -> None:
        rows = spans[number]
        which = {_RECORDED: chosen[rows], _INVALID: arrays.get("invalid", np.zeros(0, bool))}
        prefixes = [prefix for prefix, of in which.items() if of.any()]
        wanted = {*names, *(f"{prefix}{name}" for prefix in prefixes for name in of_trajectories)}
        if different := wanted ^ arrays.keys():
            raise ValueError(f"{min(different)} is missing or too much")
        trials = [arrays[name].tolist() for name in ("trocar", "trial")]
        if list(zip(*trials, strict=True)) != group[rows]:
            raise ValueError("it holds other trials")

    def make(number: int) -> Generator[float, None, chunks.Arrays]:
        rows, passed, ended = spans[number], 0.0, []
        for segment in run(group[rows]):
            ended += segment.ended
            yield (segment.passed - passed) * len(group[rows])
            passed = segment.passed
        ended.sort(key=lambda episode: episode.trial)
        table = tables.from_episodes(ended)._replace(scores=score and score(ended))
        columns = tables.columns(table)
        for prefix, of in ((_RECORDED, chosen[rows]), (_INVALID, table.invalid)):
            kept = [episode for episode, keep in zip(ended, of, strict=True) if keep]
            found = recorded.take(kept, env.p_world_ref)
            columns |= {f"{prefix}{name}": values for name, values in found.items()}
        return columns

    paths = [directory / f"chunk_{number:04d}.npz" for number in range(len(spans))]
    return chunks.Parts(paths, [len(group[rows]) for rows in spans], check, make)


def _write_trajectories(directory: Path, made: list[chunks.Arrays]) -> None:
    """Writes the trajectories in all chunks to their files, none without trials."""
    for prefix, name in _FILES.items():
        parts = [
            {key.removeprefix(prefix): x for key, x in arrays.items() if key.startswith(prefix)}
            for arrays in made
        ]
        if any(parts):
            files.write_npz(directory / name, recorded.join(parts))
