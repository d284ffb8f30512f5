"""Sizes and limits that no wrist has, refused in one line."""

from typing import Any

import numpy as np

_LENGTHS, _ANGLES = ("clevis", "jaws"), ("pitch", "yaw")
_LONGEST = 1.0  # m; the lengths of real instruments in mm are more


def check_wrist(wrist: Any) -> None:
    """Checks a `Wrist`; arrays and traced values pass.

    Raises:
      ValueError: it is no wrist, a length is not in m or negative, or a limit not in rad.
    """
    if not all(hasattr(wrist, name) for name in (*_LENGTHS, *_ANGLES)):
        raise ValueError(f"wrist: expected an rcm.Wrist, got {type(wrist).__name__}")
    bounds = dict.fromkeys(_LENGTHS, (_LONGEST, "m"))
    bounds |= dict.fromkeys(_ANGLES, (np.pi / 2.0, "rad"))
    for name, (bound, unit) in bounds.items():
        value = getattr(wrist, name)
        if isinstance(value, int | float | np.number) and not 0.0 <= value < bound:
            expected = f"at least 0 and less than {bound:.3g} {unit}"
            raise ValueError(f"wrist.{name}: expected {expected}, got {value}")
