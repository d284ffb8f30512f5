"""Types of result.json and sweep.json, as far as they are read; None: the file lacks the field."""

import typing
from typing import Any, NamedTuple

import msgspec


class Trial(NamedTuple):
    """One finished trial, a row of `trials`.

    Attributes:
      trocar: index of the configuration.
      trial: number at this configuration.
      seed: of all trials.
      radius: `(A,)` m.
      polar, azimuth: `(A,)` rad.
      seen: the configuration was trained on.
      success: the strict test was met.
      loose: the task's looser test was met.
      safe: strict, and the executed RCM error always below `safe_rcm_mm`.
      invalid: the simulation diverged.
      collided: an arm touched a forbidden part.
      lost: the task became impossible.
      steps: control steps taken.
      stage: index of `Task.stages` at the end.
      labels: the task's, e.g. source and target.
      rcm_max_mm: largest executed RCM error of all arms at the ends of control steps.
      rcm_within_max_mm: the same within control steps.
      rcm_commanded_max_mm: the same of the commands.
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


# msgspec reads a NamedTuple from a list, and the trials of a file are objects.
_DEFAULTS = {"stage": None, **Trial._field_defaults}
_Row = msgspec.defstruct(
    "_Row",
    [
        (name, kind, _DEFAULTS.get(name, msgspec.NODEFAULT))
        for name, kind in typing.get_type_hints(Trial).items()
    ],
    kw_only=True,
)


class _Rate(msgspec.Struct, kw_only=True):
    successes: int
    trials: int
    rate: float | None = None
    ci95: list[float] | None = None


class LevelScores(msgspec.Struct):
    """Scores at a level of a disturbance."""

    strict: _Rate
    rcm_error_mm: dict[str, dict[str, float | None]]
    wall_force_N: dict[str, float | None] = {}


class DisturbanceScores(msgspec.Struct):
    """Scores at all levels of a disturbance."""

    unit: str
    levels: dict[str, LevelScores]


class _Split(msgspec.Struct):
    seen: _Rate
    unseen: _Rate
    all: _Rate


class _PerTrocar(_Rate, kw_only=True):
    trocar: int
    seen: bool
    radius: list[float]
    polar: list[float]
    azimuth: list[float]


class _Bin(_Rate, kw_only=True):
    low_m: float
    high_m: float


class Milliseconds(msgspec.Struct):
    """Percentiles of a time."""

    p50: float
    p95: float
    p99: float


class _ErrorsMm(msgspec.Struct, kw_only=True):
    max: float
    mean: float | None = None
    p99: float | None = None
    p99_of_successes: float | None = None


class _Policy(msgspec.Struct):
    ddim_steps: int | None = None


class _Eval(msgspec.Struct):
    time_limit_s: float | None = None


class _Config(msgspec.Struct, kw_only=True):
    seed: int | None = None
    demos: dict[str, Any]
    policy: _Policy
    train: dict[str, Any]
    eval: _Eval | None = None


class Hardware(msgspec.Struct):
    """Parts of `xla.hardware` that reports show."""

    devices: list[str] | None = None
    memory_gb: float | None = None


class ResultScene(msgspec.Struct):
    """Names of a scene's parts."""

    task: str
    arms: tuple[str, ...]
    tools: tuple[str, ...]
    cameras: tuple[str, ...]


class _Content(msgspec.Struct, kw_only=True):
    """Fields of evaluations and sweeps alike, documented at `result.Result`."""

    scene: ResultScene
    method: str
    observation: str
    control_hz: float
    benchmark_version: int | None = None
    trials: list[_Row] | None = None
    seed: int | None = None
    time_limit_s: float | None = None
    weights: str | None = None
    dataset_digest: str | None = None
    commit: str | None = None
    dirty: bool | None = None
    version: str | None = None
    rcm_error_mm: dict[str, _ErrorsMm] | None = None
    steps: dict[str, float | None] | None = None
    inference_ms: Milliseconds | None = None
    inference_ms_by_ddim_steps: dict[str, Milliseconds] | None = None
    roll_network_ms: Milliseconds | None = None
    timings_s: dict[str, float] | None = None
    warnings: list[str] | None = None
    versions: dict[str, str] | None = None
    hardware: Hardware | None = None
    jax_settings: dict[str, str] | None = None
    command: str | None = None


class Evaluation(_Content, kw_only=True):
    """Content of result.json."""

    config: _Config
    per_trocar: list[_PerTrocar]
    seen: _Rate
    unseen: _Rate
    strict: _Split
    loose: _Split
    safe: _Split


class Sweep(_Content, kw_only=True):
    """Content of sweep.json."""

    config: _Config | None = None
    by_distance: list[_Bin]
    strict: _Rate
    loose: _Rate
    safe: _Rate
