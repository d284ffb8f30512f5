"""Conversion of an episode of another dataset to poses in the task's world at `HZ`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from msgspec import structs
from scipy.spatial import transform

from starjax.addons.formats import clocks, timing, tip_poses
from starjax.addons.formats import mapping as maps
from starjax.addons.formats.base import Source
from starjax.addons.formats.mapping import ArmColumns, Map
from starjax.addons.formats.tip_poses import TipPoses
from starjax.core import errors

HZ = 30.0  # for every dataset
FAST = 1.0  # m/s, faster tips are jumps
SPINNING = 15.0  # rad/s, faster turns are jumps
_FARTHEST = 5.0  # m; tips farther from the origin are in other units
_EVEN = 0.02  # part of a period, by which even steps may be off


class Motion(NamedTuple):
    """An episode of A arms at T even control steps, in double precision.

    Attributes:
      pose, command: `[T, A]`, world frame.
      shaft: `[T, A]`, that of the tip for a straight tool.
      gripper, command_gripper: `[T, A]` in [-1, 1].
      p_world_trocar: `[T, A, 3]` m, NaN where it is to be estimated.
      times: `[N]` s of the files' steps.
      first: step of the files from which on all columns have values.
      nearest: `[T]` step of the files whose images are shown.
      notes: anomalies, one per line.
    """

    pose: TipPoses
    shaft: TipPoses
    command: TipPoses
    gripper: np.ndarray
    command_gripper: np.ndarray
    p_world_trocar: np.ndarray
    times: np.ndarray
    first: int
    nearest: np.ndarray
    notes: list[str]


def of_episode(
    source: Source, episode: int, mapping: Map, hz: float, folder: Path
) -> tuple[dict[str, np.ndarray], Motion]:
    """Reads an episode: its columns from the first step that has all values, and its motion.

    Args:
      hz: of the files.
      folder: of the mapping file, where robots' models lie.

    Raises:
      timing.Gap: it leaves more than `max_gap_s` without a value.
      errors.UsageError: a column is not what the mapping says.
    """
    names = maps.names(mapping)
    arrays = source.read(episode, list(dict.fromkeys([*names, *clocks.columns(source)])))
    if source.timing is not None:
        clocked = source.timing(episode)
    else:
        times = maps.pick(arrays, mapping.time, 1)[:, 0] if mapping.time else None
        clocked = timing.of_rows(source, arrays, times, hz)
    if clocked is None:
        return arrays, read(arrays, mapping, hz, folder)
    cameras = [camera.column for camera in mapping.cameras.values()]
    signals = clocks.related(source, [*maps.signals(mapping), *cameras])
    is_read = bool(mapping.time)
    steps = timing.of_steps(clocked.times, hz, mapping.max_gap_s, is_strict=is_read)
    first, notes = timing.usable(clocked, signals, mapping.max_gap_s)
    notes += [] if is_read else steps  # `read` has those of its own times
    arrays = {name: array[first:] for name, array in arrays.items()}
    found = read(arrays, mapping, hz, folder)
    return arrays, found._replace(
        nearest=found.nearest + first, first=first, notes=notes + found.notes
    )


def read(arrays: Mapping[str, np.ndarray], mapping: Map, hz: float, folder: Path) -> Motion:
    """Makes an episode's columns a motion; see `of_episode`."""
    length = len(next(iter(arrays.values())))
    times = maps.pick(arrays, mapping.time, 1)[:, 0] if mapping.time else np.arange(length) / hz
    notes = timing.of_steps(times, hz, mapping.max_gap_s)
    arms = [_arm(arrays, arm, mapping, folder) for arm in mapping.arms]
    for i, arm in enumerate(arms):
        notes += _jumps(times, arm.pose, f"arm {i}: " if len(arms) > 1 else "")
    wanted, nearest = _even(times)
    sampled = [_sampled(arm, times, wanted) for arm in arms]
    return Motion(
        pose=_together([arm.pose for arm in sampled]),
        shaft=_together([arm.shaft for arm in sampled]),
        command=_together([arm.command for arm in sampled]),
        gripper=np.stack([arm.gripper for arm in sampled], 1),
        command_gripper=np.stack([arm.command_gripper for arm in sampled], 1),
        p_world_trocar=np.stack([arm.p_world_trocar for arm in sampled], 1),
        times=times,
        first=0,
        nearest=nearest,
        notes=notes,
    )


def _together(arms: list[TipPoses]) -> TipPoses:
    return TipPoses(np.stack([arm.R for arm in arms], 1), np.stack([arm.p for arm in arms], 1))


class _Arm(NamedTuple):
    """One arm; None of a command that the files lack."""

    pose: TipPoses
    shaft: TipPoses
    command: Any
    gripper: np.ndarray
    command_gripper: Any
    p_world_trocar: np.ndarray


def _arm(arrays: Mapping[str, np.ndarray], arm: ArmColumns, mapping: Map, folder: Path) -> _Arm:
    def jaws(columns: maps.Columns) -> np.ndarray:
        raw = maps.pick(arrays, columns, 1)[:, 0]
        share = (raw - arm.gripper_closed) / (arm.gripper_open - arm.gripper_closed)
        return np.clip(2.0 * share - 1.0, -1.0, 1.0)

    pose = tip_poses.tip(arrays, arm, mapping, folder)
    farthest = float(np.abs(pose.p).max())
    if farthest > _FARTHEST:
        raise errors.UsageError("position", f"tips within {_FARTHEST:g} m", f"{farthest:.3g} m")
    if arm.trocar:
        trocar = tip_poses.placed(maps.pick(arrays, arm.trocar, 3), mapping)
    elif arm.trocar_at:
        metres = structs.replace(mapping, units="m")
        trocar = np.tile(tip_poses.placed(np.array(arm.trocar_at), metres), (len(pose.p), 1))
    else:
        trocar = np.full_like(pose.p, np.nan)
    return _Arm(
        pose,
        tip_poses.shaft(arrays, arm, mapping, folder, pose),
        tip_poses.command(arrays, arm, mapping),
        jaws(arm.gripper) if arm.gripper else np.ones(len(pose.p)),
        jaws(arm.command_gripper) if arm.command_gripper else None,
        trocar,
    )


def _jumps(times: np.ndarray, pose: TipPoses, whose: str) -> list[str]:
    steps = np.maximum(np.diff(times), 1e-9)
    if not len(steps):
        return []
    speed = np.linalg.norm(np.diff(pose.p, axis=0), axis=-1) / steps
    turned = transform.Rotation.from_matrix(pose.R[1:] @ pose.R[:-1].swapaxes(-1, -2))
    spin = turned.magnitude() / steps
    odd = (speed > FAST) | (spin > SPINNING)
    if not odd.any():
        return []
    at = int(np.argmax(odd))
    return [
        f"{whose}{int(odd.sum())} jumps, the first at {times[at] - times[0]:.2f} s "
        f"({speed[at]:.2g} m/s, {spin[at]:.2g} rad/s)"
    ]


def _even(times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns even times at `HZ`, and the nearest recorded step of each."""
    if len(times) == 1 or np.abs(np.diff(times) * HZ - 1.0).max() < _EVEN:
        return times, np.arange(len(times))
    count = int(np.floor((times[-1] - times[0]) * HZ + 1e-6)) + 1
    wanted = times[0] + np.arange(count) / HZ
    middles = 0.5 * (times[1:] + times[:-1])
    return wanted, np.searchsorted(middles, wanted)


def _sampled(arm: _Arm, times: np.ndarray, wanted: np.ndarray) -> _Arm:
    """Resamples an arm; a missing command is the arm's next step."""
    if wanted is not times:

        def along(x: np.ndarray) -> np.ndarray:
            rows = x.reshape(len(x), -1)
            return np.stack([np.interp(wanted, times, row) for row in rows.T], -1).reshape(
                len(wanted), *x.shape[1:]
            )

        def moved(pose: TipPoses) -> TipPoses:
            # The shorter way between two rotations: neither signs of quaternions nor angles beyond
            # a whole turn matter.
            turning = transform.Slerp(times, transform.Rotation.from_matrix(pose.R))
            within = np.clip(wanted, times[0], times[-1])
            return TipPoses(turning(within).as_matrix(), along(pose.p))

        pose = moved(arm.pose)
        arm = _Arm(
            pose,
            pose if arm.shaft is arm.pose else moved(arm.shaft),
            arm.command and moved(arm.command),
            along(arm.gripper),
            arm.command_gripper if arm.command_gripper is None else along(arm.command_gripper),
            along(arm.p_world_trocar),
        )
    command = arm.command or TipPoses(_following(arm.pose.R), _following(arm.pose.p))
    gripper = arm.command_gripper
    return arm._replace(
        command=command, command_gripper=_following(arm.gripper) if gripper is None else gripper
    )


def _following(x: np.ndarray) -> np.ndarray:
    return np.concatenate([x[1:], x[-1:]])
