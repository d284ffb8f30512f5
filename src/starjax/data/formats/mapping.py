"""Mapping file: meaning, units and frames of the columns of a dataset.

TOML or JSON. A column is named as the files name it, with the numbers that are meant:
`observation.state[0:3]`, `action[6]`, or several as a list.
"""

import dataclasses
import json
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np

from starjax import config, errors
from starjax.data.formats.base import Source

Columns = str | tuple[str, ...]
Turned = Literal["quat_xyzw", "quat_wxyz", "matrix", "rot6d", "rotvec", "euler_xyz"]

# Numbers of each way to write a rotation: a matrix by rows, rot6d by its first two columns, Euler's
# angles about fixed axes x, y, z in rad.
NUMBERS = {
    "quat_xyzw": 4, "quat_wxyz": 4, "matrix": 9, "rot6d": 6, "rotvec": 3, "euler_xyz": 3
}  # fmt: skip
_PART = re.compile(r"(.+?)(?:\[(\d+)(?:(:)(\d+))?\])?")
_FILE = "--map"


@dataclasses.dataclass(frozen=True, kw_only=True)
class ArmColumns:
    """Columns of one arm. Empty ones are not there."""

    position: Columns = ()  # of the tip, 3 numbers
    rotation: Columns = ()  # of the tip, as `rotation_as` says
    rotation_as: Turned = "quat_xyzw"
    joints: Columns = ()  # instead of the two: positions of the joints, rad and m
    model: str = ""  # of the robot, an MJCF or URDF beside the mapping file
    joint_names: tuple[str, ...] = ()  # in the model, in the order of `joints`; left out, its first
    body: str = ""  # body or site of the model that is the tip
    gripper: Columns = ()  # one number; left out, the jaws are open throughout
    gripper_closed: float = -1.0  # what it is when they are closed
    gripper_open: float = 1.0  # what it is when they are open
    command_position: Columns = ()  # what was asked for; left out, the next tip
    command_rotation: Columns = ()
    command_gripper: Columns = ()
    trocar: Columns = ()  # its position, 3 numbers; left out, estimated from the motion
    tip: tuple[float, ...] = (0.0, 0.0, 0.0)  # m, the tip in the frame that the poses are of
    # of the tip in that frame, wxyz: z of the tip is the shaft, distal, y where the jaws open
    tip_turn: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class CameraColumn:
    """A camera of the task, and the column of its images."""

    column: str
    crop: tuple[int, ...] = ()  # top, left, height, width in pixels
    size: int = 0  # pixels per side afterwards; 0: as they are
    bgr: bool = False  # whether blue comes first


@dataclasses.dataclass(frozen=True, kw_only=True)
class Map:
    """A whole mapping file."""

    task: str  # of starjax, whose nominal trocars and cameras the dataset gets
    units: Literal["m", "mm"] = "m"  # of positions
    hz: float = 0.0  # of the files, where they do not say it, or say it wrong
    time: Columns = ()  # s, where steps are not evenly spaced
    origin: tuple[float, ...] = (0.0, 0.0, 0.0)  # m, of the files' frame in the task's world
    turn: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0)  # of the files' frame in that world, wxyz
    state: Columns = ()  # what the task says of its state
    success: Columns = ()  # above 0.5 at the end where an episode succeeded; left out, all did
    trocars: Literal["episode", "dataset"] = "episode"  # what shares a trocar that is estimated
    max_gap_s: float = 0.5  # episodes with a longer gap are left out
    arms: tuple[Any, ...] = ()
    cameras: Any = dataclasses.field(default_factory=dict)


def load(path: Path) -> Map:
    """Reads a mapping file.

    Raises:
      errors.UsageError: it cannot be read, or says something that a mapping does not.
    """
    try:
        text = path.read_text()
        values = json.loads(text) if path.suffix == ".json" else tomllib.loads(text)
        return _parsed(values)
    except OSError as error:
        raise errors.UsageError(_FILE, "a mapping file", f"{path}: {error.strerror}") from error
    except (ValueError, TypeError, AttributeError) as error:
        raise errors.UsageError(_FILE, "a mapping", f"{path}: {error}") from error


def as_json(mapping: Map) -> dict[str, Any]:
    """Returns the mapping as JSON values, for the record."""
    return json.loads(json.dumps(dataclasses.asdict(mapping)))


def pick(arrays: Mapping[str, np.ndarray], columns: Columns, count: int = 0) -> np.ndarray:
    """Returns the entries `[T, n]` of columns; n must equal `count` unless that is 0.

    Raises:
      errors.UsageError: there are others, or one is not finite.
    """
    parts = []
    for text in _listed(columns):
        name, low, high = _part(text)
        array = np.asarray(arrays[name], np.float64)
        rows = array.reshape(len(array), -1)[:, low:high]
        bad = ~np.isfinite(rows).all(-1)
        if bad.any():
            where = f"{rows[bad][0].tolist()} at step {int(np.argmax(bad))}"
            raise errors.UsageError(text, "finite numbers", where)
        parts.append(rows)
    found = np.concatenate(parts, -1)
    if count and found.shape[1] != count:
        raise errors.UsageError(_said(columns), f"{count} numbers", found.shape[1])
    return found


def names(mapping: Map) -> list[str]:
    """Returns the columns that a mapping reads, except images."""
    given = [mapping.time, mapping.state, mapping.success]
    for arm in mapping.arms:
        given += [arm.position, arm.rotation, arm.joints, arm.gripper, arm.trocar]
        given += [arm.command_position, arm.command_rotation, arm.command_gripper]
    parts = [_part(text)[0] for columns in given for text in _listed(columns)]
    return list(dict.fromkeys(parts))


def check(mapping: Map, source: Source) -> None:
    """Raises UsageError for what the mapping names and the dataset lacks."""
    for name in names(mapping):
        errors.choice(f"{_FILE}: column", name, source.columns)
    for camera in mapping.cameras.values():
        images = [name for name, column in source.columns.items() if column.is_image]
        errors.choice(f"{_FILE}: image column", camera.column, images or ["none: no images"])


def _parsed(values: dict[str, Any]) -> Map:
    rest = {name: value for name, value in values.items() if name not in ("arms", "cameras")}
    arms = tuple(config.from_dict(ArmColumns, arm) for arm in values.get("arms", []))
    cameras = {
        name: config.from_dict(CameraColumn, camera)
        for name, camera in values.get("cameras", {}).items()
    }
    found = dataclasses.replace(config.from_dict(Map, rest), arms=arms, cameras=cameras)
    _expect(bool(arms), "one [[arms]] or more", "none")
    for name, count in (("origin", 3), ("turn", 4)):
        _expect(len(getattr(found, name)) == count, f"{name} of {count} numbers", rest.get(name))
    for arm in arms:
        poses = bool(arm.position and arm.rotation) and not arm.joints
        kinematics = bool(arm.joints and arm.model and arm.body) and not arm.position
        _expect(poses or kinematics, "position and rotation, or joints, model and body", arm)
        asked = bool(arm.command_position) == bool(arm.command_rotation)
        _expect(asked and not (arm.joints and arm.command_position), "a whole command", arm)
        _expect(len(arm.tip) == 3 and len(arm.tip_turn) == 4, "tip [3], tip_turn [4]", arm)
        _expect(arm.gripper_open != arm.gripper_closed, "jaws that differ", arm.gripper_open)
    for camera in cameras.values():
        _expect(len(camera.crop) in (0, 4), "crop [top, left, height, width]", camera.crop)
        _expect(min(camera.crop, default=0) >= 0 and camera.size >= 0, "pixels", camera)
    return found


def _expect(holds: bool, expected: str, got: object) -> None:
    if not holds:
        raise ValueError(f"expected {expected}, got {got}")


def _listed(columns: Columns) -> tuple[str, ...]:
    return (columns,) if isinstance(columns, str) else columns


def _said(columns: Columns) -> str:
    return ", ".join(_listed(columns))


def _part(text: str) -> tuple[str, int, int | None]:
    """Parses a column's name and its slice: first index, and index after the last or None."""
    found = _PART.fullmatch(text)
    assert found is not None
    name, low, colon, high = found.groups()
    if low is None:
        return name, 0, None
    return name, int(low), int(high) if colon else int(low) + 1
