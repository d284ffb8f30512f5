"""Files next to a result.json: sweep, stress, bench, and the log of the training."""

import json
from pathlib import Path
from typing import Any

import msgspec

from starjax.core import config_json, methods
from starjax.evaluation import result, structure
from starjax.evaluation.content import DisturbanceScores, Hardware, Milliseconds
from starjax.runtime import files

Lines = list[dict[str, Any]]


class _Bench(msgspec.Struct, kw_only=True):
    weights: str | None = None
    inference_ms_by_ddim_steps: dict[str, Milliseconds]
    roll_network_ms: Milliseconds | None = None
    hardware: Hardware | None = None


class _Stress(msgspec.Struct):
    weights: str
    disturbances: dict[str, DisturbanceScores]


class _Line(msgspec.Struct):
    step: int
    loss: float | None = None
    position_error_mm: float | None = None
    roll_error_deg: float | None = None


def sweep(folder: Path) -> result.Result | None:
    """Reads the last sweep of a run, or None."""
    file = folder / "sweep.json"
    return result.read_sweep(file) if file.is_file() else None


def bench(folder: Path) -> dict[str, Any]:
    """Reads bench.json of a run, empty if missing.

    Raises:
      ValueError: it is damaged; the message names it.
    """
    file = folder / "bench.json"
    if not file.is_file():
        return {}
    content = files.read_json(file)
    structure.convert(file, content, _Bench)
    return content


def stress(folder: Path, weights: str | None) -> dict[str, Any]:
    """Reads the newest stress.json of a run with these weights, empty if missing.

    Raises:
      ValueError: it is damaged; the message names it.
    """
    candidates = sorted(
        folder.glob("stress-seed*/stress.json"), key=lambda path: path.stat().st_mtime
    )
    for file in reversed(candidates):
        content = files.read_json(file)
        structure.convert(file, content, _Stress)
        if weights is None or content["weights"] == weights:
            return content
    return {}


def curves(folder: Path, scored: result.Result) -> tuple[Path | None, Lines]:
    """Returns the training log of a result's weights, and its lines.

    Methods that share weights share the log, in the folder of one of them. There are no lines if
    the log belongs to a training with other settings.
    """
    places = [folder]
    if folder.name == scored.method:
        places.insert(0, folder.parent / methods.SCORED[scored.method].weights_of)
    for place in places:
        file = place / "metrics.jsonl"
        if lines := _lines(file):
            return file.resolve(), lines if _is_of(place, scored) else []
    return None, []


def _is_of(folder: Path, scored: result.Result) -> bool:
    """Returns True if a folder's training had the settings of a result, or if unknown."""
    try:
        trained = files.read_json(folder / "config.json")
        same_seed = trained["seed"] == scored.config.get("seed", trained["seed"])
        return same_seed and not config_json.differing_settings([trained, scored.config])
    except (FileNotFoundError, AttributeError, KeyError, TypeError, ValueError):
        return True  # missing, damaged or of another version: unknown


def _lines(file: Path) -> Lines:
    """Reads the complete lines of a log: a kill may have truncated the last one."""
    lines = file.read_bytes().splitlines(keepends=True) if file.is_file() else []
    try:
        values = [json.loads(line) for line in lines if line.endswith(b"\n")]
    except ValueError as error:
        raise ValueError(f"{file} is damaged: {error}") from error
    for number, line in enumerate(values, 1):
        structure.convert(file, line, _Line, f"line {number}")
    return values
