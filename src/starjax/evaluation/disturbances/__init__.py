"""Disturbances of an operating theatre, by name. `--help` and errors read this: no jax here.

Other packages add theirs by an entry point of the group `starjax.disturbances` that names a
`base.Disturbance`.
"""

import math
from collections.abc import Sequence

from starjax.core import errors
from starjax.core.registry import Registry

_HERE = "starjax.evaluation.disturbances"

DISTURBANCES = Registry(
    "disturbance",
    {
        "trocar_offset": f"{_HERE}.trocars:TROCAR_OFFSET",
        "breathing": f"{_HERE}.trocars:BREATHING",
        "breathing_tracked": f"{_HERE}.trocars:BREATHING_TRACKED",
        "camera": f"{_HERE}.images:CAMERA",
        "darkness": f"{_HERE}.images:DARKNESS",
        "tint": f"{_HERE}.images:TINT",
        "noise": f"{_HERE}.images:NOISE",
        "blur": f"{_HERE}.images:BLUR",
        "smoke": f"{_HERE}.images:SMOKE",
        "blood": f"{_HERE}.images:BLOOD",
        "observation_delay": f"{_HERE}.timing:OBSERVATION_DELAY",
        "action_delay": f"{_HERE}.timing:ACTION_DELAY",
        "observation_dropout": f"{_HERE}.timing:OBSERVATION_DROPOUT",
        "weak_servos": f"{_HERE}.physics:WEAK_SERVOS",
        "friction": f"{_HERE}.physics:FRICTION",
        "mass": f"{_HERE}.physics:MASS",
        "cable_slack": f"{_HERE}.wrists:CABLE_SLACK",
        "look": f"{_HERE}.images:LOOK",
    },
    f"{_HERE}.base:Disturbance",
)


def chosen_levels(argument: str, texts: Sequence[str]) -> dict[str, tuple[float, ...]]:
    """Parses disturbances of the form `NAME` or `NAME=LEVEL`, which may come several times.

    Returns:
      name -> 0 and the chosen levels, empty without a chosen level.

    Raises:
      errors.UsageError: a text has another form, or names no disturbance.
    """
    chosen: dict[str, tuple[float, ...]] = {}
    for text in texts:
        if "=" not in text:
            errors.choice(argument, text, DISTURBANCES.names())
            chosen.setdefault(text, ())
            continue
        ((name, level),) = parse_levels(argument, [text]).items()
        chosen[name] = (*(chosen.get(name) or (0.0,)), level)
    return chosen


def parse_levels(argument: str, texts: Sequence[str]) -> dict[str, float]:
    """Parses levels of the form `NAME=LEVEL`.

    Raises:
      errors.UsageError: a text has another form, names no disturbance, or repeats one.
    """
    levels: dict[str, float] = {}
    for text in texts:
        name, _, number = text.partition("=")
        errors.choice(argument, name, DISTURBANCES.names())
        try:
            level = float(number)
        except ValueError:
            raise errors.UsageError(argument, "NAME=LEVEL, LEVEL a number", text) from None
        if name in levels or not (math.isfinite(level) and level > 0):
            raise errors.UsageError(argument, "each name once, its level more than 0", text)
        levels[name] = level
    return levels
