"""Disturbances of a theatre, by name. `--help` and mistakes read this: no jax here.

Others add theirs by an entry point of the group `starjax.disturbances` that names a
`base.Disturbance`.
"""

import math
from collections.abc import Sequence

from starjax import errors
from starjax.registry import Registry

_HERE = "starjax.evaluation.disturbances"

DISTURBANCES = Registry(
    "disturbance",
    {
        "trocar_told": f"{_HERE}.trocars:TOLD_WRONGLY",
        "breathing": f"{_HERE}.trocars:BREATHING",
        "breathing_late": f"{_HERE}.trocars:BREATHING_LATE",
        "camera": f"{_HERE}.images:CAMERA",
        "darkness": f"{_HERE}.images:DARKNESS",
        "tint": f"{_HERE}.images:TINT",
        "noise": f"{_HERE}.images:NOISE",
        "blur": f"{_HERE}.images:BLUR",
        "smoke": f"{_HERE}.images:SMOKE",
        "blood": f"{_HERE}.images:BLOOD",
        "late_view": f"{_HERE}.timing:LATE_VIEW",
        "late_commands": f"{_HERE}.timing:LATE_COMMANDS",
        "dropped": f"{_HERE}.timing:DROPPED",
        "servos": f"{_HERE}.physics:SERVOS",
        "friction": f"{_HERE}.physics:FRICTION",
        "mass": f"{_HERE}.physics:MASS",
    },
)


def check(argument: str, names: Sequence[str]) -> None:
    """Raises errors.UsageError for the first of `names` that is no disturbance."""
    known = DISTURBANCES.names()
    for name in names:
        errors.choice(argument, name, known)


def levels_of(argument: str, written: Sequence[str]) -> dict[str, float]:
    """Reads levels that are written `NAME=LEVEL`.

    Raises:
      errors.UsageError: one is written otherwise, is of no disturbance, or comes twice.
    """
    found: dict[str, float] = {}
    for one in written:
        name, _, level = one.partition("=")
        check(argument, [name])
        try:
            found[name], before = float(level), name in found
        except ValueError:
            raise errors.UsageError(argument, "NAME=LEVEL, LEVEL a number", one) from None
        if before or not (math.isfinite(found[name]) and found[name] > 0):
            raise errors.UsageError(argument, "each name once, its level more than 0", one)
    return found
