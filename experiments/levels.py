"""Success of policies at the highest levels of disturbances, of disturbances/levels.toml."""

import json
import tomllib
from pathlib import Path
from typing import Any

import columns

from starjax.report import formats

HERE = Path(__file__).resolve().parent
RESULTS = HERE.parent / "benchmarks" / "results"


def table() -> str:
    """Returns a line per disturbance and level, a column per policy; a dash where unmeasured."""
    spec = tomllib.loads((HERE / "disturbances" / "levels.toml").read_text())
    found = [[_read(file) for file in policy["files"]] for policy in spec["policies"]]
    rows = [["Disturbance", *(policy["label"] for policy in spec["policies"])]]
    for level in spec["levels"]:
        rows.append([level["name"], *(_cell(results, level["keys"]) for results in found)])
    return formats.render(rows, names=1)


def _cell(results: list[dict[str, Any]], keys: list[str]) -> str:
    for result in results:
        for key in keys:
            result = result.get(key, {})
        if result:
            counts = result["strict"]["successes"], result["strict"]["trials"]
            return columns.counted(*counts, result["strict"]["ci95"])
    return "\u2013"


def _read(file: str) -> dict[str, Any]:
    return json.loads((RESULTS / f"{file}.json").read_text())
