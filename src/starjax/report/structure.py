"""What the report counts on in the JSON that it reads, checked before it does.

A kind is a type, a list of one kind, or an object: a kind by name, `?` after the names of what may
be missing or null, or one kind by `*` for every name.
"""

import json
from pathlib import Path
from typing import Any

_NUMBER = int | float
_WORDS = {
    dict: "an object",
    list: "a list",
    str: "text",
    bool: "true or false",
    int: "a whole number",
    _NUMBER: "a number",
}

_MS = {"p50": _NUMBER, "p95": _NUMBER, "p99": _NUMBER}
_ERRORS = {"max": _NUMBER, "mean?": _NUMBER, "p99?": _NUMBER, "p99_of_successes?": _NUMBER}
_HARDWARE = {"devices?": [str], "memory_gb?": _NUMBER}
_TRIAL = {
    **dict.fromkeys(("trocar", "trial", "seed", "steps"), int),
    **dict.fromkeys(("radius", "polar", "azimuth"), _NUMBER),
    **dict.fromkeys(("seen", "success", "loose", "safe"), bool),
    **dict.fromkeys(("rcm_max_mm?", "rcm_within_max_mm?"), _NUMBER),
}
_CONFIG = {
    "seed?": int,
    "demos": dict,
    "policy": {"ddim_steps": int},
    "train": dict,
    "eval?": {"time_limit_s?": _NUMBER},
}
RESULT = {
    "method": str,
    "observation": str,
    "config": _CONFIG,
    "seed?": int,
    "weights?": str,
    "trials?": [_TRIAL],
    "inference_ms?": _MS,
    "inference_ms_by_ddim_steps?": {"*": _MS},
    "roll_network_ms?": _MS,
    "rcm_error_mm?": {"*": _ERRORS},
    "timings_s?": {"*": _NUMBER},
    "warnings?": [str],
    "hardware?": _HARDWARE,
    "command?": str,
}
BESIDE = {
    "sweep.json": {
        "weights?": str,
        "time_limit_s?": _NUMBER,
        "trials?": [{**_TRIAL, "distance_m": _NUMBER}],
    },
    "bench.json": {
        "weights?": str,
        "inference_ms_by_ddim_steps": {"*": _MS},
        "roll_network_ms?": _MS,
        "hardware?": _HARDWARE,
    },
}
# Of metrics.jsonl.
LINE = {"step": int, "loss?": _NUMBER, "position_error_mm?": _NUMBER, "roll_error_deg?": _NUMBER}


def check(file: Path, value: Any, kind: Any, place: str = "") -> None:
    """Raises a ValueError that names `file` and the place in it if `value` is not of `kind`."""
    types = type(kind) if isinstance(kind, dict | list) else kind
    if not isinstance(value, types):
        got = "nothing" if value is None else json.dumps(value)[:60]
        raise ValueError(f"{file}: {place}: expected {_WORDS[types]}, got {got}")
    if isinstance(kind, list):
        for i, item in enumerate(value):
            check(file, item, kind[0], f"{place}[{i}]")
    if isinstance(kind, dict):
        for name, part in kind.items():
            for key in value if name == "*" else [name.removesuffix("?")]:
                found = value.get(key)
                if found is not None or not name.endswith("?"):
                    check(file, found, part, f"{place}.{key}" if place else key)
