"""Kinds of all fields of result.json and sweep.json, for `structure.check`."""

from typing import Any

from starjax.evaluation.structure import NUMBER

NEWEST = 2  # schema

_RATE = {"successes": int, "trials": int, "rate?": NUMBER, "ci95?": [NUMBER]}
_SPLIT = {"seen": _RATE, "unseen": _RATE, "all": _RATE}
_MS = {"p50": NUMBER, "p95": NUMBER, "p99": NUMBER}
_ERRORS = {"max": NUMBER, "mean?": NUMBER, "p99?": NUMBER, "p99_of_successes?": NUMBER}
PLACE = ("radius", "polar", "azimuth")
_FLAGS = ("seen", "success", "loose", "safe", "invalid", "collided")
WORST = ("rcm_max_mm", "rcm_within_max_mm", "rcm_commanded_max_mm", "distance_m")


_TRIAL = {
    **dict.fromkeys(("trocar", "trial", "seed", "steps"), int),
    **{name: [NUMBER] for name in PLACE},
    **dict.fromkeys(_FLAGS, bool),
    **dict.fromkeys([f"{name}?" for name in WORST], NUMBER),
    "labels": {"*": int},
    "lost": bool,
    "stage?": int,
}
RESULT: dict[str, Any] = {
    "scene": {"task": str, "arms": [str], "tools": [str], "cameras": [str]},
    "method": str,
    "observation": str,
    "trials?": [_TRIAL],
    "per_trocar?": [{name: [NUMBER] for name in PLACE} | {"trocar": int, "seen": bool} | _RATE],
    "seed?": int,
    "time_limit_s?": NUMBER,
    "control_hz": NUMBER,
    "weights?": str,
    "config?": {
        "seed?": int,
        "demos": dict,
        "policy": {"ddim_steps?": int},
        "train": dict,
        "eval?": {"time_limit_s?": NUMBER},
    },
    "rcm_error_mm?": {"*": _ERRORS},
    "steps?": {"mean?": NUMBER, "median?": NUMBER},
    "inference_ms?": _MS,
    "inference_ms_by_ddim_steps?": {"*": _MS},
    "roll_network_ms?": _MS,
    "timings_s?": {"*": NUMBER},
    "warnings?": [str],
    "versions?": {"*": str},
    "hardware?": {"devices?": [str], "memory_gb?": NUMBER},
    "jax_settings?": {"*": str},
    "command?": str,
    **dict.fromkeys(("commit?", "version?", "dataset_digest?"), str),
    "dirty?": bool,
}
EVALUATION = {"config": dict, "per_trocar": list, **dict.fromkeys(("seen", "unseen"), _RATE)}
EVALUATION |= dict.fromkeys(("strict", "loose", "safe"), _SPLIT)
SWEEP = {"by_distance": [{"low_m": NUMBER, "high_m": NUMBER, **_RATE}]}
SWEEP |= dict.fromkeys(("strict", "loose", "safe"), _RATE)
