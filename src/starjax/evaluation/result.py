"""Typed results: result.json and sweep.json, written and read here alone.

A result names its scene, the code and the demonstrations. A trial's radius, polar and azimuth are
lists `[A]`, its labels an object.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from starjax.core import learners, sources
from starjax.evaluation import protocol, structure, trial_file
from starjax.evaluation.content import Evaluation, Sweep, Trial
from starjax.evaluation.paired import paired as paired
from starjax.runtime import files, jax_settings, provenance, xla
from starjax.sim import names, registries

SCHEMA = 2


class Result(NamedTuple):
    """An evaluation or a sweep, and its origin; None and empty: the file lacks the field.

    Attributes:
      schema: of the file.
      scene: the task, its arms, tools and cameras.
      method: a row of `methods.METHODS`.
      observation: `image` or `state`.
      seed: of the trials.
      time_limit_s: of a trial, simulated; 0 if unknown.
      control_hz: control steps per second.
      trials: in order of configuration and number.
      figures: from `statistics.compose` or `sweep.compose`, without the trials.
      config: settings of the run as JSON values, empty for a sweep.
      weights: SHA-256 of the policy's file.
      dataset_digest: of the demonstrations that trained the policy.
      commit, dirty, version: of the code, see `provenance.Code`.
      about: all other fields: benchmark_version, command, preset, versions, hardware, timings_s,
        warnings, inference_ms and so on.
    """

    schema: int
    scene: names.SceneNames
    method: str
    observation: str
    seed: int | None
    time_limit_s: float
    control_hz: float
    trials: tuple[Trial, ...]
    figures: dict[str, Any]
    config: dict[str, Any]
    weights: str | None
    dataset_digest: str | None
    commit: str | None
    dirty: bool | None
    version: str | None
    about: dict[str, Any]


_FIGURES = (
    "seen", "unseen", "generalization_gap", "generalization_gap_ci95", "strict", "loose", "safe",
    "safe_rcm_mm", "per_trocar", "by_distance", "rcm_error_mm", "steps", "invalid", "collided",
)  # fmt: skip


def read(file: Path) -> Result:
    """Reads a result.json.

    Raises:
      FileNotFoundError: the file is missing.
      ValueError: it is damaged, or no result; the message names the file and the field.
    """
    return _parse(file, trial_file.read(file), Evaluation)


def read_sweep(file: Path) -> Result:
    """Reads a sweep.json; raises as `read`."""
    return _parse(file, trial_file.read(file), Sweep)


def write(
    file: Path, scene: names.SceneNames, figures: Mapping[str, Any], about: Mapping[str, Any]
) -> Result:
    """Writes a result.json or sweep.json, with the code and the machine that made it.

    Args:
      figures: from `statistics.compose` or `sweep.compose`.
      about: JSON values by name: control_hz, seed, weights, dataset_digest and command; of an
        evaluation config, preset, inference_ms, timings_s and warnings; of a sweep time_limit_s.
    """
    parts = parts_of(scene, about.get("config", {}))
    content = {
        "schema": SCHEMA,
        "benchmark_version": protocol.VERSION,
        "scene": scene._asdict(),
        **figures,
        **about,
        **provenance.code()._asdict(),
        **sources.record(parts),
        "versions": {**xla.versions(), **sources.packages(parts)},
        "hardware": xla.hardware(),
        **jax_settings.record(),
    }
    values = json.loads(json.dumps(content))
    result = _parse(file, values, Sweep if "by_distance" in values else Evaluation)
    files.write_json(file, values)
    return result


def parts_of(scene: names.SceneNames, settings: Mapping[str, Any]) -> list[sources.Identity]:
    """Returns the identity of each part that a result depends on.

    Args:
      settings: of the run, JSON values as far as known.
    """
    policy = settings.get("policy", {})
    names = ("learner", "encoder", "depth_encoder")
    of_policy = [policy.get(name, "") for name in names]
    return [*registries.parts(scene), *learners.parts(settings.get("method", ""), *of_policy)]


def _parse(file: Path, values: dict[str, Any], kind: type[Evaluation] | type[Sweep]) -> Result:
    """Returns the typed result in JSON values; `file` is named in errors."""
    schema = values.get("schema", 1)
    if schema != SCHEMA:
        raise ValueError(f"{file}: expected schema {SCHEMA}, got {schema!r}; evaluate again")
    content = structure.convert(file, values, kind)
    config = content.config
    seed, limit_s = content.seed, content.time_limit_s
    if config is not None:
        seed = config.seed if seed is None else seed
        limit_s = limit_s or (config.eval and config.eval.time_limit_s)
    scene = content.scene
    known = {*Result._fields, *_FIGURES}
    return Result(
        schema=schema,
        scene=names.SceneNames(scene.task, scene.arms, scene.tools, scene.cameras),
        method=content.method,
        observation=content.observation,
        seed=seed,
        time_limit_s=limit_s or 0.0,
        control_hz=content.control_hz,
        trials=tuple(Trial(**msgspec.structs.asdict(row)) for row in content.trials or ()),
        figures={name: values[name] for name in _FIGURES if name in values},
        config=values.get("config") or {},
        about={name: value for name, value in values.items() if name not in known},
        weights=content.weights,
        dataset_digest=content.dataset_digest,
        commit=content.commit,
        dirty=content.dirty,
        version=content.version,
    )
