"""Facts of an import that contradict each other: units, frames, commands, grippers, trocars."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from starjax.data.formats import mapping as maps
from starjax.data.formats.mapping import ArmColumns, Map
from starjax.data.formats.motion import Motion
from starjax.sim import registries

_LEAST_MOTION = 5e-3  # m; the tips of a demonstration move farther
_STEPS_AWAY = 10.0  # typical steps between a command and the next tip
_LEAST_AWAY = 5e-3  # m; a command nearer to the next tip follows it
_BEYOND = 0.05  # of a gripper's range, by which values may leave it
_LEAST_USED = 0.5  # of a gripper's range, which a dataset uses
_OUTSIDE = 0.02  # m, from the region of a task's trocars


class Jaws:
    """Ranges of the grippers' values over a dataset, as shares of closed to open."""

    def __init__(self, arms: Sequence[ArmColumns]):
        self._arms = arms
        self._low, self._high = np.full(len(arms), np.inf), np.full(len(arms), -np.inf)

    def add(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Takes the columns of an episode."""
        for i, arm in enumerate(self._arms):
            if arm.gripper:
                raw = maps.pick(arrays, arm.gripper, 1)
                share = (raw - arm.gripper_closed) / (arm.gripper_open - arm.gripper_closed)
                self._low[i] = min(self._low[i], share.min())
                self._high[i] = max(self._high[i], share.max())

    def notes(self) -> Iterator[str]:
        """Yields a note for each gripper that leaves its range or uses little of it."""
        for i, (arm, low, high) in enumerate(zip(self._arms, self._low, self._high)):
            is_outside = low < -_BEYOND or high > 1.0 + _BEYOND
            if np.isfinite(low) and (is_outside or high - low < _LEAST_USED):
                width = arm.gripper_open - arm.gripper_closed
                first, last = (arm.gripper_closed + width * x for x in (low, high))
                yield (
                    f"the gripper of arm {i} is from {first:.3g} to {last:.3g}, where "
                    f"gripper_closed = {arm.gripper_closed:g}, gripper_open = {arm.gripper_open:g}"
                )


def of_commands(found: Motion, mapping: Map) -> Iterator[str]:
    """Yields a note for each arm of an episode whose commands are far from the next tips."""
    steps = np.linalg.norm(np.diff(found.pose.p, axis=0), axis=-1)
    if not len(steps):
        return
    away = np.linalg.norm(found.command.p[:-1] - found.pose.p[1:], axis=-1)
    added = np.linalg.norm(
        found.pose.p[:-1] + found.command.p[:-1] - np.array(mapping.origin) - found.pose.p[1:],
        axis=-1,
    )
    for i, arm in enumerate(mapping.arms):
        distance = float(np.median(away[:, i]))
        most = max(_LEAST_AWAY, _STEPS_AWAY * float(np.median(steps[:, i])))
        if arm.command_position and distance > most:
            is_relative = np.median(added[:, i]) < 0.5 * distance
            why = "; they look relative to the tip" if is_relative else ""
            yield f"commands of arm {i} are {1e3 * distance:.0f} mm from the next tip{why}"


def of_dataset(
    tips: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]],
    places: np.ndarray,
    numbers: Sequence[int],
    task: Any,
) -> Iterator[str]:
    """Yields notes on the motion's extent, the shafts' direction and the trocars' region.

    Args:
      tips: of each episode rotations `[T, A, 3, 3]`, positions `[T, A, 3]` m, and anything.
      places: `[E, A, 3]` m, trocars.
      numbers: of the episodes.
    """
    extent = max(float(np.ptp(p, axis=0).max()) for _, p, _ in tips)
    if extent < _LEAST_MOTION:
        yield f"no tip moves more than {1e3 * extent:.2g} mm: are units and hz right?"
    for (R, p, _), place, number in zip(tips, places, numbers):
        depth = np.median(np.sum((p - place) * R[..., 2], -1), axis=0)
        for i in np.flatnonzero(depth <= 0.0).tolist():
            yield (
                f"episode {number}: tips of arm {i} lie {-1e3 * depth[i]:.0f} mm before the "
                "trocar: is z of tip_turn distal?"
            )
    for i, slot in enumerate(task.slots):
        reference = np.array(slot.p_world_ref)
        most = registries.workspaces.get(slot.workspace).radius[1] + _OUTSIDE
        away = np.linalg.norm(places[:, i] - reference, axis=-1)
        if (far := away > most).any():
            yield (
                f"{int(far.sum())} trocars of arm {i} lie up to {1e3 * away.max():.0f} mm from the "
                f"task's nominal one, at most {1e3 * most:.0f} mm: are origin and turn right?"
            )


def of_state(arrays: Mapping[str, np.ndarray], mapping: Map, task: Any) -> Iterator[str]:
    """Yields a note if the state has another size than the task's."""
    if mapping.state:
        size, wanted = maps.pick(arrays, mapping.state).shape[1], task.state_size
        if size != wanted:
            yield f"the state has {size} numbers, which task {task.name} has {wanted} of"
