"""Files next to a result.json: sweep, stress, bench, and the log of the training."""

import json
from pathlib import Path
from typing import Any

from starjax import config, methods
from starjax.evaluation import result, structure
from starjax.evaluation.structure import NUMBER
from starjax.runtime import files

_MS = {"p50": NUMBER, "p95": NUMBER, "p99": NUMBER}
_BENCH = {
    "weights?": str,
    "inference_ms_by_ddim_steps": {"*": _MS},
    "roll_network_ms?": _MS,
    "hardware?": {"devices?": [str], "memory_gb?": NUMBER},
}
_RATE = {"successes": int, "trials": int, "rate": NUMBER}
_ERROR = {"executed": {"mean": NUMBER, "p99?": NUMBER}}
_LEVEL = {"strict": _RATE, "rcm_error_mm": _ERROR, "wall_force_N?": {"p99?": NUMBER}}
_STRESS = {
    "weights": str,
    "disturbances": {"*": {"unit": str, "levels": {"*": _LEVEL}}},
}
_LINE = {"step": int, "loss?": NUMBER, "position_error_mm?": NUMBER, "roll_error_deg?": NUMBER}

Lines = list[dict[str, Any]]


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
    found = files.read_json(file)
    structure.check(file, found, _BENCH)
    return found


def stress(folder: Path, weights: str | None) -> dict[str, Any]:
    """Reads the newest stress.json of a run with these weights, empty if missing.

    Raises:
      ValueError: it is damaged; the message names it.
    """
    found = sorted(folder.glob("stress-seed*/stress.json"), key=lambda path: path.stat().st_mtime)
    for file in reversed(found):
        content = files.read_json(file)
        structure.check(file, content, _STRESS)
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
        places.insert(0, folder.parent / methods.METHODS[scored.method].weights_of)
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
        return same_seed and not config.differing_settings([trained, scored.config])
    except (FileNotFoundError, AttributeError, KeyError, TypeError, ValueError):
        return True  # missing, damaged or of another version: unknown


def _lines(file: Path) -> Lines:
    """Reads the complete lines of a log: a kill may have truncated the last one."""
    lines = file.read_bytes().splitlines(keepends=True) if file.is_file() else []
    try:
        found = [json.loads(line) for line in lines if line.endswith(b"\n")]
    except ValueError as error:
        raise ValueError(f"{file} is damaged: {error}") from error
    for number, line in enumerate(found, 1):
        structure.check(file, line, _LINE, f"line {number}")
    return found
