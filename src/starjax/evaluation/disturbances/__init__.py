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
# Old name -> name. Files of earlier versions hold the old ones.
RENAMED = {
    "trocar_told": "trocar_offset",
    "breathing_late": "breathing_tracked",
    "late_view": "observation_delay",
    "late_commands": "action_delay",
    "dropped": "observation_dropout",
    "servos": "weak_servos",
}


def current_name(name: str) -> str:
    """Returns the name of the disturbance that a file of any version calls `name`."""
    return RENAMED.get(name, name)


def resolve(argument: str, names: Sequence[str]) -> list[str]:
    """Returns today's names of disturbances; warns of old ones.

    Raises:
      errors.UsageError: a name is unknown.
    """
    known = DISTURBANCES.names()
    for name in names:
        if name in RENAMED:
            errors.warn_renamed(name, RENAMED[name])
        else:
            errors.choice(argument, name, known)
    return [current_name(name) for name in names]


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
            chosen.setdefault(resolve(argument, [text])[0], ())
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
        old_or_new, _, number = text.partition("=")
        (name,) = resolve(argument, [old_or_new])
        try:
            level = float(number)
        except ValueError:
            raise errors.UsageError(argument, "NAME=LEVEL, LEVEL a number", text) from None
        if name in levels or not (math.isfinite(level) and level > 0):
            raise errors.UsageError(argument, "each name once, its level more than 0", text)
        levels[name] = level
    return levels
