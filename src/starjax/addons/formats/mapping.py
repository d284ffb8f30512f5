"""Mapping file: meaning, units and frames of the columns of a dataset.

TOML or JSON. A column is named as the files name it, with the numbers that are meant:
`observation.state[0:3]`, `action[6]`, or several as a list.
"""

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import structs

from starjax.addons.formats.base import Source
from starjax.core import errors

Columns = str | tuple[str, ...]
Turned = Literal["quat_xyzw", "quat_wxyz", "matrix", "rot6d", "rotvec", "euler_xyz"]
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]  # wxyz
Count = Annotated[int, msgspec.Meta(ge=0)]

# Numbers of each way to write a rotation: a matrix by rows, rot6d by its first two columns, Euler's
# angles about fixed axes x, y, z in rad.
NUMBERS = {
    "quat_xyzw": 4, "quat_wxyz": 4, "matrix": 9, "rot6d": 6, "rotvec": 3, "euler_xyz": 3
}  # fmt: skip
_NEWER_MAP = {"about": "", "fits": {}, "skip": [], "splits": [], "place": "files"}
_NEWER_ARM = {"trocar_at": []}
_NOT_RECORDED = ("about", "fits")
_OF_MAP = ("time", "state", "success")
_OF_ARM = (
    *("position", "rotation", "joints", "gripper", "trocar"),
    *("command_position", "command_rotation", "command_gripper"),
)
_OF_SHAFT = ("angles", "position", "rotation")
_PART = re.compile(r"(.+?)(?:\[(\d+)(?:(:)(\d+))?\])?")
_FILE = "--map"


class _MapPart(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Part of a mapping file."""


class ShaftColumns(_MapPart, frozen=True, kw_only=True):
    """Columns of the shaft of an instrument with a wrist: one of three ways to write its poses."""

    angles: Columns = ()  # pitch and yaw of the wrist, rad, as `rcm.tip_of` has them
    instrument: Literal["", "large_needle_driver", "prograsp"] = ""  # whose wrist it is
    position: Columns = ()  # position of a point of the shaft, 3 numbers
    rotation: Columns = ()  # rotation of the shaft, as the arm's `rotation_as` says
    body: str = ""  # body or site of the arm's model that is on the shaft
    turn: Quaternion = (1.0, 0.0, 0.0, 0.0)  # wxyz, to z along the shaft, distal

    def __post_init__(self) -> None:
        ways = (self.angles, self.instrument), (self.position, self.rotation), (self.body,)
        used = [way for way in ways if any(way)]
        if len(used) != 1 or not all(used[0]):
            raise ValueError("expected angles and instrument, position and rotation, or body")


class ArmColumns(_MapPart, frozen=True, kw_only=True):
    """Columns of one arm. Empty ones are not there."""

    position: Columns = ()  # position of the tip, 3 numbers
    rotation: Columns = ()  # rotation of the tip, as `rotation_as` says
    rotation_as: Turned = "quat_xyzw"
    joints: Columns = ()  # instead of the two: positions of the joints, rad and m
    model: str = ""  # model of the robot, an MJCF or URDF beside the mapping file
    joint_names: tuple[str, ...] = ()  # in the model, in the order of `joints`; left out, its first
    body: str = ""  # body or site of the model that is the tip
    gripper: Columns = ()  # one number; left out, the jaws are open throughout
    gripper_closed: float = -1.0  # what it is when they are closed
    gripper_open: float = 1.0  # what it is when they are open
    command_position: Columns = ()  # what was asked for; left out, the next tip
    command_rotation: Columns = ()
    # `delta`: relative to the measured position and rotation, in the files' frame; the rotation
    # comes after the measured one. The record of a mapping without it stays the same.
    command_as: Literal["delta"] | msgspec.UnsetType = msgspec.UNSET
    command_rotation_as: Turned | msgspec.UnsetType = msgspec.UNSET  # left out, `rotation_as`
    command_gripper: Columns = ()
    trocar: Columns = ()  # its position, 3 numbers; left out, estimated from the motion
    trocar_at: tuple[float, ...] = ()  # m, instead of the column: in the files' frame
    tip: Vector = (0.0, 0.0, 0.0)  # m, the tip in the frame that the poses are of
    # rotation of the tip in that frame: z of the tip is the shaft, distal, y where the jaws open
    tip_turn: Quaternion = (1.0, 0.0, 0.0, 0.0)
    # shaft of an instrument with a wrist; absent, the tip's z is the shaft. The record of a mapping
    # without it stays the same.
    shaft: ShaftColumns | msgspec.UnsetType = msgspec.UNSET

    def __post_init__(self) -> None:
        poses = bool(self.position and self.rotation) and not self.joints
        kinematics = bool(self.joints and self.model and self.body) and not self.position
        if not (poses or kinematics):
            raise ValueError("expected position and rotation, or joints, model and body")
        is_whole = bool(self.command_position) == bool(self.command_rotation)
        if not is_whole or (self.joints and self.command_position):
            raise ValueError("expected a whole command, of position and rotation")
        if isinstance(self.shaft, ShaftColumns) and self.shaft.body and not self.joints:
            raise ValueError("expected joints and a model for the body of the shaft")
        if len(self.trocar_at) not in (0, 3) or (self.trocar_at and self.trocar):
            raise ValueError("expected trocar_at [x, y, z], or a column trocar")
        if self.gripper_open == self.gripper_closed:
            raise ValueError("expected gripper_open other than gripper_closed")


class CameraColumn(_MapPart, frozen=True, kw_only=True):
    """A camera of the task, and the column of its images."""

    column: str
    crop: tuple[Count, ...] = ()  # top, left, height, width in pixels
    size: Count = 0  # pixels per side afterwards; 0: as they are
    bgr: bool = False  # whether blue comes first

    def __post_init__(self) -> None:
        if len(self.crop) not in (0, 4):
            raise ValueError("expected crop [top, left, height, width]")


class Map(_MapPart, frozen=True, kw_only=True):
    """A whole mapping file."""

    about: str = ""  # a line for people
    fits: dict[str, int | tuple[str, ...]] = {}  # columns it is for: sizes or first names
    task: str  # task of starjax, whose nominal trocars and cameras the dataset gets
    units: Literal["m", "mm"] = "m"  # unit of positions
    hz: float = 0.0  # rate of the files, where they do not say it, or say it wrong
    time: Columns = ()  # s, where steps are not evenly spaced
    origin: Vector = (0.0, 0.0, 0.0)  # m, of the files' frame in the task's world
    turn: Quaternion = (1.0, 0.0, 0.0, 0.0)  # rotation of the files' frame in that world
    state: Columns = ()  # what the task says of its state
    success: Columns = ()  # above 0.5 at the end where an episode succeeded; left out, all did
    trocars: Literal["episode", "dataset"] = "episode"  # what shares a trocar that is estimated
    max_gap_s: float = 0.5  # episodes with a longer gap are left out
    skip: tuple[Count, ...] = ()  # episodes to leave out
    splits: tuple[str, ...] = ()  # splits whose episodes are imported; default: all
    # where the tool works: as origin and turn say, or the mean trocar at the task's nominal one and
    # the mean shaft pointing down
    place: Literal["files", "trocar"] = "files"
    arms: Annotated[tuple[ArmColumns, ...], msgspec.Meta(min_length=1)]
    cameras: dict[str, CameraColumn] = {}


def load(path: Path) -> Map:
    """Reads a mapping file.

    Raises:
      errors.UsageError: it cannot be read, or says something that a mapping does not.
    """
    decode = msgspec.json.decode if path.suffix == ".json" else msgspec.toml.decode
    try:
        text = path.read_text("utf-8-sig")  # editors may put a byte order mark in front
        return decode(text, type=Map)
    except OSError as error:
        raise errors.UsageError(_FILE, "a mapping file", f"{path}: {error.strerror}") from error
    except (ValueError, RecursionError, msgspec.MsgspecError) as error:
        text = " ".join(str(error).split())
        raise errors.UsageError(_FILE, "a mapping", f"{path}: {text}") from error


def as_json(mapping: Map) -> dict[str, Any]:
    """Returns the mapping as JSON values, for the record.

    Omits fields that older versions lack if they have no effect: digests hold.
    """
    values = msgspec.json.decode(msgspec.json.encode(mapping))
    for part, newer in ((values, _NEWER_MAP), *((arm, _NEWER_ARM) for arm in values["arms"])):
        for name, unchanged in newer.items():
            if part[name] == unchanged or name in _NOT_RECORDED:
                del part[name]
    return values


def pick(arrays: Mapping[str, np.ndarray], columns: Columns, count: int = 0) -> np.ndarray:
    """Returns the entries `[T, n]` of columns; n must equal `count` unless that is 0.

    Raises:
      errors.UsageError: there are others, or one is not finite.
    """
    parts = []
    for text in listed(columns):
        name, low, high = part(text)
        array = np.asarray(arrays[name], np.float64)
        rows = array.reshape(len(array), -1)[:, low:high]
        bad = ~np.isfinite(rows).all(-1)
        if bad.any():
            where = f"{rows[bad][0].tolist()} at step {int(np.argmax(bad))}"
            raise errors.UsageError(f"column {text}", "finite numbers", where)
        parts.append(rows)
    entries = np.concatenate(parts, -1)
    if count and entries.shape[1] != count:
        raise errors.UsageError(", ".join(listed(columns)), f"{count} numbers", entries.shape[1])
    return entries


def names(mapping: Map) -> list[str]:
    """Returns the columns that a mapping reads, those of arms first, except images."""
    columns: list[Columns] = []

    def take(some: Columns) -> Columns:
        columns.append(some)
        return some

    with_columns(mapping, take)
    return list(dict.fromkeys(part(text)[0] for some in columns for text in listed(some)))


def signals(mapping: Map) -> list[str]:
    """Returns the columns that move: all that a mapping reads but times and facts."""
    arms = tuple(structs.replace(arm, trocar=()) for arm in mapping.arms)
    return names(structs.replace(mapping, arms=arms, time=(), success=()))


def has_shaft(mapping: Map) -> bool:
    """Returns True if an arm has an instrument with a wrist."""
    return any(isinstance(arm.shaft, ShaftColumns) for arm in mapping.arms)


def check(mapping: Map, source: Source) -> None:
    """Raises UsageError for what the mapping names and the dataset lacks."""
    for name in names(mapping):
        errors.choice(f"{_FILE}: column", name, source.columns)
    for camera in mapping.cameras.values():
        images = [name for name, column in source.columns.items() if column.is_image]
        errors.choice(f"{_FILE}: image column", camera.column, images or ["none: no images"])


def with_columns(mapping: Map, change: Callable[[Columns], Columns]) -> Map:
    """Returns a mapping with all its columns of numbers changed."""

    def changed(table: Any, names: Sequence[str]) -> Any:
        return structs.replace(table, **{name: change(getattr(table, name)) for name in names})

    arms = []
    for arm in mapping.arms:
        arm = changed(arm, _OF_ARM)
        if isinstance(arm.shaft, ShaftColumns):
            arm = structs.replace(arm, shaft=changed(arm.shaft, _OF_SHAFT))
        arms.append(arm)
    return structs.replace(changed(mapping, _OF_MAP), arms=tuple(arms))


def listed(columns: Columns) -> tuple[str, ...]:
    """Returns the parts of columns."""
    return (columns,) if isinstance(columns, str) else columns


def part(text: str) -> tuple[str, int, int | None]:
    """Parses a column's name and its slice: first index, and index after the last or None."""
    match = _PART.fullmatch(text)
    assert match is not None
    name, low, colon, high = match.groups()
    if low is None:
        return name, 0, None
    return name, int(low), int(high) if colon else int(low) + 1
