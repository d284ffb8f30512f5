"""Typed results: the schema of result.json and sweep.json.

Written and read here alone. A trial's radius, polar and azimuth are lists `[A]`, its labels an
object.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from starjax.evaluation import kinds, structure, trial_file
from starjax.runtime import files, jax_settings, provenance, xla
from starjax.sim import names

SCHEMA = kinds.NEWEST


class Trial(NamedTuple):
    """One finished trial, a row of `trials`.

    Attributes:
      trocar: index of the configuration; trial: number there; seed: of the trials.
      radius: `(A,)` m. polar, azimuth: `(A,)` rad.
      seen: the configuration was trained on.
      success: strict. loose: the task's looser test was met. safe: strict, and the executed RCM
        error always below `safe_rcm_mm`.
      invalid: the simulation diverged. collided: an arm touched what it must not. lost: the task
        could not be done any more.
      steps: control steps taken.
      stage: how far the task came, an index of `Task.stages`; None if the file lacks it.
      labels: the task's, e.g. source and target.
      rcm_max_mm, rcm_within_max_mm, rcm_commanded_max_mm: the largest of all arms, executed at the
        ends of control steps, within them, and commanded; None where the file does not say it.
      distance_m: in sweeps, m to the nearest configuration of training.
    """

    trocar: int
    trial: int
    seed: int
    radius: tuple[float, ...]
    polar: tuple[float, ...]
    azimuth: tuple[float, ...]
    seen: bool
    success: bool
    loose: bool
    safe: bool
    invalid: bool
    collided: bool
    lost: bool
    steps: int
    stage: int | None
    labels: dict[str, int]
    rcm_max_mm: float | None = None
    rcm_within_max_mm: float | None = None
    rcm_commanded_max_mm: float | None = None
    distance_m: float | None = None


class Result(NamedTuple):
    """An evaluation or a sweep, and what made it. None and empty: the file does not say it.

    Attributes:
      schema: of the file.
      scene: the task, its arms, tools and cameras.
      method: a row of `methods.METHODS`. observation: `image` or `state`.
      seed: of the trials.
      time_limit_s: of a trial, simulated, 0 where the file does not say it.
      control_hz: control steps a second.
      trials: in order of configuration and number.
      figures: what `statistics.compose` or `sweep.compose` gave, without the trials.
      config: settings of the run as JSON values, empty for a sweep.
      weights: SHA-256 of the policy's file; dataset_digest: of the demonstrations it comes from.
      commit, dirty, version: the code, see `provenance.Code`.
      about: everything else that stands in the file: command, preset, versions, hardware,
        timings_s, warnings, inference_ms and so on.
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
_MADE_BY = ("weights", "dataset_digest", "commit", "dirty", "version")


def read(file: Path) -> Result:
    """Reads a result.json of any schema.

    Raises:
      FileNotFoundError: there is none.
      ValueError: it is damaged, or no result; the message names the file and the place in it.
    """
    return _parse(file, trial_file.read(file), kinds.EVALUATION)


def read_sweep(file: Path) -> Result:
    """Reads a sweep.json of any schema; raises as `read`."""
    return _parse(file, trial_file.read(file), kinds.SWEEP)


def write(
    file: Path, scene: names.SceneNames, figures: Mapping[str, Any], about: Mapping[str, Any]
) -> Result:
    """Writes a result.json or sweep.json, with the code and the machine that made it.

    Args:
      figures: of `statistics.compose` or `sweep.compose`.
      about: JSON values by name: control_hz, seed, weights, dataset_digest and command; of an
        evaluation config, preset, inference_ms, timings_s and warnings; of a sweep time_limit_s.
    """
    content = {
        "schema": SCHEMA,
        "scene": scene._asdict(),
        **figures,
        **about,
        **provenance.code()._asdict(),
        "versions": xla.versions(),
        "hardware": xla.hardware(),
        **jax_settings.record(),
    }
    found = json.loads(json.dumps(content))
    result = _parse(file, found, kinds.SWEEP if "by_distance" in found else kinds.EVALUATION)
    files.write_json(file, found)
    return result


def _parse(file: Path, found: dict[str, Any], further: Mapping[str, Any]) -> Result:
    """The typed result in JSON values read from `file`, which is only named in errors.

    Args:
      further: kinds of what this sort of result has beside what all have.
    """
    schema = found.get("schema", 1)
    if schema != SCHEMA:
        raise ValueError(f"{file}: expected schema {SCHEMA}, got {schema!r}; evaluate again")
    structure.check(file, found, kinds.RESULT | dict(further))
    scene, config = found["scene"], found.get("config") or {}
    limit_s = found.get("time_limit_s") or (config.get("eval") or {}).get("time_limit_s") or 0.0
    known = {*Result._fields, *_FIGURES}
    return Result(
        schema=schema,
        scene=names.SceneNames(
            scene["task"], *(tuple(scene[name]) for name in ("arms", "tools", "cameras"))
        ),
        method=found["method"],
        observation=found["observation"],
        seed=found.get("seed", config.get("seed")),
        time_limit_s=limit_s,
        control_hz=found["control_hz"],
        trials=tuple(map(_trial, found.get("trials") or [])),
        figures={name: found[name] for name in _FIGURES if name in found},
        config=config,
        about={name: value for name, value in found.items() if name not in known},
        **{name: found.get(name) for name in _MADE_BY},
    )


def _trial(row: dict[str, Any]) -> Trial:
    fields: dict[str, Any] = {name: row.get(name) for name in Trial._fields}
    fields |= {name: tuple(row[name]) for name in kinds.PLACE}
    return Trial(**fields)
