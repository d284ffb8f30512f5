"""Ranges of values over a dataset: jaws within closed to open, joints within their limits."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from starjax.addons.formats import mapping as maps
from starjax.addons.formats import tip_poses
from starjax.addons.formats.mapping import ArmColumns

_BEYOND = 0.05  # part of a gripper's range, by which values may leave it
_LEAST_USED = 0.5  # part of a gripper's range, which a dataset uses
_STILL = 1e-3  # part of a gripper's range, by which jaws that stay closed, or open, move
_SLACK = 0.02  # part of a joint's range, by which values may pass a limit


class Jaws:
    """Ranges of the grippers' values over a dataset, as shares of closed to open."""

    def __init__(self, arms: Sequence[ArmColumns]):
        self._arms = arms
        self._low, self._high = np.full(len(arms), np.inf), np.full(len(arms), -np.inf)

    def add(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Takes the columns of an episode."""
        for i, arm in enumerate(self._arms):
            for columns in filter(None, (arm.gripper, arm.command_gripper)):
                raw = maps.pick(arrays, columns, 1)
                share = (raw - arm.gripper_closed) / (arm.gripper_open - arm.gripper_closed)
                self._low[i] = min(self._low[i], share.min())
                self._high[i] = max(self._high[i], share.max())

    def notes(self) -> Iterator[str]:
        """Yields a note for each gripper that leaves its range or uses little of it.

        Jaws that stay closed, or open, are no doubt: a task may begin with a held needle.
        """
        for i, (arm, low, high) in enumerate(zip(self._arms, self._low, self._high)):
            is_outside = low < -_BEYOND or high > 1.0 + _BEYOND
            is_still = high < _STILL or low > 1.0 - _STILL
            is_small = high - low < _LEAST_USED and not is_still
            if np.isfinite(low) and (is_outside or is_small):
                width = arm.gripper_open - arm.gripper_closed
                first, last = (arm.gripper_closed + width * x for x in (low, high))
                yield (
                    f"the gripper of arm {i} is from {first:.3g} to {last:.3g}, where "
                    f"gripper_closed = {arm.gripper_closed:g}, gripper_open = {arm.gripper_open:g}"
                )


class Joints:
    """Ranges of the joints' values over a dataset, compared with the limits of their models."""

    def __init__(self, arms: Sequence[ArmColumns], folder: Path):
        self._arms, self._folder = arms, folder
        self._ranges: dict[int, tuple[np.ndarray, np.ndarray]] = {}

    def add(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Takes the columns of an episode."""
        for i, arm in enumerate(self._arms):
            if arm.joints:
                rows = maps.pick(arrays, arm.joints)
                low, high = self._ranges.get(i, (rows[0], rows[0]))
                self._ranges[i] = np.minimum(low, rows.min(0)), np.maximum(high, rows.max(0))

    def notes(self) -> Iterator[str]:
        """Yields notes on joints beyond their limits, with the likely unit."""
        for i, (lows, highs) in self._ranges.items():
            rows = tip_poses.limits(self._arms[i], self._folder, len(lows))
            for row, least, most in zip(rows, lows, highs):
                yield from _beyond(row, i, float(least), float(most))


def _beyond(row: tip_poses.JointLimits, arm: int, least: float, most: float) -> Iterator[str]:
    name, turns, low, high = row
    slack = _SLACK * (high - low)
    if low - slack <= least and most <= high + slack:
        return
    unit, other, scale = ("rad", "degrees", np.pi / 180) if turns else ("m", "mm", 1e-3)
    is_other = low - slack <= scale * least and scale * most <= high + slack
    why = f": are they {other}?" if is_other else ""
    value = most if most - high > low - least else least
    yield (
        f"joint {name} of arm {arm} is at {value:.4g}, beyond its limits {low:.4g} to {high:.4g} "
        f"{unit}{why}"
    )
