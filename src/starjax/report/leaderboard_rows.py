"""One row of the trocar benchmark from one result of evaluate, sweep or stress."""

import types
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from starjax.core import methods
from starjax.evaluation import protocol, result, structure
from starjax.evaluation.content import DisturbanceScores, ResultScene
from starjax.report import formats, outcomes, stats
from starjax.runtime import files
from starjax.sim import registries

_DIGITS = 8  # for a digest
_SEEN = [True] * protocol.SEEN + [False] * (protocol.TROCARS - protocol.SEEN)


class Row(NamedTuple):
    """A policy's scores on a task.

    Attributes:
      task: its name; arms: of its robots, in the order of its slots.
      method: name in tables. policy: learner, preset and training, or a server's address; empty
        without an evaluation.
      version: of the benchmark, None if the results name none.
      weights: first digits of their digest.
      seen, unseen, others: strict success at the trocars of the demonstrations, at the task's other
        ones, and at those of a sweep; None without the result.
      rcm_p99_mm: executed RCM error of all trials of the evaluation, None if unknown.
      stress: disturbance -> strict success at the protocol's level.
      commit: of the code; several are joined.
      commands: command lines of the results.
      files: the results.
    """

    task: str
    arms: tuple[str, ...]
    method: str
    policy: str
    version: int | None
    weights: str = ""
    seen: stats.Rate | None = None
    unseen: stats.Rate | None = None
    others: stats.Rate | None = None
    rcm_p99_mm: float | None = None
    stress: Mapping[str, stats.Rate] = types.MappingProxyType({})
    commit: str = ""
    commands: tuple[str, ...] = ()
    files: tuple[str, ...] = ()

    @property
    def stressed(self) -> stats.Rate | None:
        """Strict success over the protocol's disturbances together, None if one is missing."""
        if self.stress.keys() != protocol.STRESS.keys():
            return None
        scores = self.stress.values()
        return stats.rate(sum(s.successes for s in scores), sum(s.trials for s in scores))


# Key, equal for results of one policy; its scores; differences of its trials from the protocol's.
RowOfFile = tuple[Any, Row, list[str]]


class _StressFile(msgspec.Struct, kw_only=True):
    scene: ResultScene
    method: str
    weights: str
    seed: int
    trials_at_each_trocar: int
    time_limit_s: float
    disturbances: dict[str, DisturbanceScores]
    benchmark_version: int | None = None
    commit: str | None = None
    dirty: bool | None = None
    command: str = ""


def of_file(path: Path) -> RowOfFile:
    """Reads a result of any of the three commands.

    Raises:
      ValueError: it is damaged, or no result; the message names it.
    """
    content = files.read_json(path)
    for key, read in _READERS.items():
        if key in content:
            return read(path)
    kinds = ", ".join(protocol.COMMANDS)
    raise ValueError(f"{path}: expected a result of {kinds}, got another file")


def _evaluation(path: Path) -> RowOfFile:
    scored = result.read(path)
    trials = [trial for trial in scored.trials if trial.trial < protocol.TRIALS]
    reasons = list(protocol.departures("evaluate", *_trials(scored)))
    is_seen = {trial.trocar: trial.seen for trial in trials}
    if not reasons and [*map(is_seen.get, range(protocol.TROCARS))] != _SEEN:
        reasons.append(f"trained at {sum(is_seen.values())} trocars, not the first {protocol.SEEN}")
    seen, unseen = outcomes.rates(trials)
    executed = (scored.figures.get("rcm_error_mm") or {}).get("executed") or {}
    row = _row(scored, path)._replace(seen=seen, unseen=unseen, rcm_p99_mm=executed.get("p99"))
    return (*_key(scored, path), _is_ensemble(scored)), row, reasons


def _sweep(path: Path) -> RowOfFile:
    scored = result.read_sweep(path)
    row = _row(scored, path)._replace(others=outcomes.tally(scored.trials))
    reasons = list(protocol.departures("sweep", *_trials(scored)))
    return (*_key(scored, path), False), row, reasons


def _stress(path: Path) -> RowOfFile:
    found = structure.convert(path, files.read_json(path), _StressFile)
    scene, version = found.scene, found.benchmark_version
    scores = {}
    for name, kind in found.disturbances.items():
        score = kind.levels.get(f"{protocol.STRESS[name]:g}") if name in protocol.STRESS else None
        if score:
            scores[name] = stats.rate(score.strict.successes, score.strict.trials)
    row = Row(
        *(scene.task, scene.arms, _method(found.method), "", version, found.weights[:_DIGITS]),
        stress=scores,
        commit=formats.code(found.commit, found.dirty),
        commands=(found.command,),
        files=(str(path),),
    )
    key = (scene.task, scene.arms, found.method, found.weights, version, False)
    trials = scene.task, found.seed, found.time_limit_s, protocol.TROCARS
    reasons = protocol.departures("stress", *trials, found.trials_at_each_trocar)
    return key, row, list(reasons)


# Key that only results of one command have -> their reader.
_READERS = {"by_distance": _sweep, "disturbances": _stress, "per_trocar": _evaluation}


def _trials(scored: result.Result) -> tuple[str, int | None, float, int, int]:
    counts: dict[int, int] = {}
    for trial in scored.trials:
        counts[trial.trocar] = counts.get(trial.trocar, 0) + 1
    least = min(counts.values(), default=0)
    return scored.scene.task, scored.seed, scored.time_limit_s, len(counts), least


def _key(scored: result.Result, path: Path) -> tuple[Any, ...]:
    # Old results lack their weights: those of one directory belong together.
    weights = scored.weights or path.parent
    version = scored.about.get("benchmark_version")
    return scored.scene.task, scored.scene.arms, scored.method, weights, version


def _row(scored: result.Result, path: Path) -> Row:
    return Row(
        task=scored.scene.task,
        arms=scored.scene.arms,
        method=_method(scored.method),
        policy=", ".join(_described(scored)),
        version=scored.about.get("benchmark_version"),
        weights=(scored.weights or "")[:_DIGITS],
        commit=formats.code(scored.commit, scored.dirty),
        commands=(scored.about.get("command") or "",),
        files=(str(path),),
    )


def _method(name: str) -> str:
    return methods.SCORED[name].label if name in methods.SCORED else name


def _observes(scored: result.Result) -> Iterator[str]:
    """Yields the observation if it is not the first camera of the task."""
    cameras = scored.scene.cameras
    if scored.observation != "image":
        yield scored.observation
    elif cameras != registries.tasks.get(scored.scene.task).cameras[:1]:
        yield " + ".join(cameras)
    if depth := (scored.config.get("policy") or {}).get("depth_encoder"):
        yield f"depth by {depth}"


def _is_ensemble(scored: result.Result) -> bool:
    """Returns True if a result's plans were averaged."""
    return bool((scored.config.get("eval") or {}).get("ensemble"))


def _described(scored: result.Result) -> Iterator[str]:
    """Yields learner, preset, training steps and unusual settings of a policy."""
    config = scored.config
    if server := scored.about.get("server"):
        yield str(server.get("address", "server"))
    elif config:  # a sweep's is empty
        yield (config.get("policy") or {}).get("learner") or "diffusion"
        yield from filter(None, [config.get("preset")])
        if steps := (config.get("train") or {}).get("steps"):
            yield f"{steps:,} steps"
        yield from _observes(scored)
        if _is_ensemble(scored):
            yield "ensembled"
        if seed := config.get("seed"):
            yield f"seed {seed}"
