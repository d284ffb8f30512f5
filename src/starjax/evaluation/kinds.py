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


def _trial_kind(number: Any, labels: Any) -> dict[str, Any]:
    return {
        **dict.fromkeys(("trocar", "trial", "seed", "steps"), int),
        **dict.fromkeys(PLACE, number),
        **dict.fromkeys(_FLAGS, bool),
        **dict.fromkeys([f"{name}?" for name in WORST], NUMBER),
        **labels,
    }


def _kind(number: Any, labels: Any) -> dict[str, Any]:
    """The structure of a file in which a place is `number`s, and a trial has these `labels`."""
    return {
        "method": str,
        "observation": str,
        "trials?": [_trial_kind(number, labels)],
        "per_trocar?": [dict.fromkeys(PLACE, number) | {"trocar": int, "seen": bool} | _RATE],
        "seed?": int,
        "time_limit_s?": NUMBER,
        "control_hz?": NUMBER,
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
    }


_CODE = {"commit?": str, "dirty?": bool, "version?": str, "dataset_digest?": str}
_SCENE = {"scene": {"task": str, "arms": [str], "tools": [str], "cameras": [str]}}
EVALUATION = {"config": dict, "per_trocar": list, **dict.fromkeys(("seen", "unseen"), _RATE)}
EVALUATION |= dict.fromkeys(("strict", "loose", "safe"), _SPLIT)
SWEEP = {"by_distance": [{"low_m": NUMBER, "high_m": NUMBER, **_RATE}]}
SWEEP |= dict.fromkeys(("strict", "loose", "safe"), _RATE)
_LABELS = {
    1: {"source?": int, "target?": int},
    2: {"labels": {"*": int}, "lost": bool, "stage?": int},
}
KINDS = {
    1: _kind(NUMBER, _LABELS[1]),
    2: {**_kind([NUMBER], _LABELS[2]), **_SCENE, **_CODE, "control_hz": NUMBER},
}
