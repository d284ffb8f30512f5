"""The description of a robot: a TOML file with its topics, frames, trocar and limits."""

import dataclasses
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from starjax.addons.robots import crtk, psm
from starjax.addons.robots.crtk import Jaw
from starjax.core.errors import UsageError
from starjax.core.types import Pose

INSTRUMENTS = {"large_needle_driver": psm.LARGE_NEEDLE_DRIVER, "prograsp": psm.PROGRASP}
VIEW = "view"  # the frame of commands relative to the endoscope


@dataclasses.dataclass(frozen=True)
class ArmTable:
    """Table `[arm]`.

    Attributes:
      namespace: of the arm's topics, e.g. `/PSM1`.
      command: `servo_jp`, joints by the closed kinematics of a PSM, or `servo_cp`, poses.
      frame: name of the base frame, or `view`: `servo_cp` relative to the endoscope.
      instrument: key of `INSTRUMENTS`.
      closed, open: rad, angles of the jaws.
      position, quaternion_xyzw: of the base in the policy's world, m.
      rate: Hz, of the commands; a policy has 30 Hz, in between they are interpolated.
    """

    namespace: str
    command: str = "servo_jp"
    frame: str = "PSM1_base"
    instrument: str = "large_needle_driver"
    closed: float = -0.25
    open: float = 1.0
    position: tuple[float, ...] = (0.0, 0.0, 0.15)
    quaternion_xyzw: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0)
    rate: float = 120.0


@dataclasses.dataclass(frozen=True)
class TrocarTable:
    """Table `[trocar]`: `position`, m in the world, and a topic (PointStamped) that may move it."""

    position: tuple[float, ...] = ()
    topic: str = ""


@dataclasses.dataclass(frozen=True)
class CameraTable:
    """Table `[camera.NAME]`: the topic of an Image, cropped to its middle square."""

    topic: str


@dataclasses.dataclass(frozen=True)
class LimitsTable:
    """Table `[limits]`: speeds in m/s and rad/s, tolerances in s and m; see `deploy.guard`."""

    speed: float = 0.015
    turn_rate: float = 0.3
    stale_s: float = 0.2
    following_m: float = 0.004
    off_trocar_m: float = 0.003


@dataclasses.dataclass(frozen=True)
class Network:
    """Table `[network]`, where the robot's topics are.

    Attributes:
      domain: `ROS_DOMAIN_ID` of the robot.
      interface: of the computer, such as `eth0`; `lo`: this computer only, without multicast;
        empty: DDS's own choice, with multicast.
      peers: addresses of other computers, in place of multicast.
    """

    domain: int = 0
    interface: str = ""
    peers: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True)
class RobotFile:
    """A robot as its file describes it."""

    arm: ArmTable
    trocar: TrocarTable
    cameras: dict[str, CameraTable]
    limits: LimitsTable
    network: Network

    @property
    def instrument(self) -> psm.Instrument:
        """Returns the sizes of the instrument."""
        return INSTRUMENTS[self.arm.instrument]

    @property
    def jaw(self) -> Jaw:
        """Returns the angles of the jaws."""
        return Jaw(self.arm.closed, self.arm.open)

    @property
    def pose_world_base(self) -> Pose:
        """Returns the base frame in the policy's world."""
        R = Rotation.from_quat(self.arm.quaternion_xyzw).as_matrix()
        return crtk.pose_of_arrays(R, np.array(self.arm.position))

    @property
    def p_world_trocar(self) -> np.ndarray:
        """Returns the trocar `[3]` m at the start; that of a PSM is its remote centre."""
        return np.array(self.trocar.position or self.arm.position, np.float32)


def read(path: str | Path) -> RobotFile:
    """Reads a robot's file.

    Raises:
      UsageError: it is missing, not TOML, or a table or value is unknown or impossible.
    """
    try:
        tables = tomllib.loads(Path(path).read_text())
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise UsageError(str(path), "the TOML file of a robot", str(error)) from None
    cameras = tables.pop("camera", {})
    kinds = {"arm": ArmTable, "trocar": TrocarTable, "limits": LimitsTable, "network": Network}
    for name in set(tables) - set(kinds):
        raise UsageError(f"{path}: {name}", f"one of {', '.join([*kinds, 'camera'])}", "unknown")
    parts = {name: _table(path, name, kind, tables.get(name, {})) for name, kind in kinds.items()}
    made = {name: _table(path, f"camera.{name}", CameraTable, row) for name, row in cameras.items()}
    robot = RobotFile(cameras=made, **parts)
    _check(path, robot)
    return robot


def _table(path: Any, name: str, kind: Any, values: Any) -> Any:
    """Returns a table as its record, every value of the record's type."""
    fields = {field.name: field for field in dataclasses.fields(kind)}
    if not isinstance(values, dict):
        raise UsageError(f"{path}: {name}", "a table", type(values).__name__)
    for key, value in values.items():
        if key not in fields:
            raise UsageError(f"{path}: {name}.{key}", f"one of {', '.join(fields)}", "unknown")
        expected = {str: "text", int: "a whole number", float: "a number"}
        kinds: Any = (int, float) if fields[key].type is float else fields[key].type
        if fields[key].type in expected and (
            not isinstance(value, kinds) or isinstance(value, bool)
        ):
            raise UsageError(f"{path}: {name}.{key}", expected[fields[key].type], repr(value))
        if fields[key].type not in expected and not isinstance(value, list):
            raise UsageError(f"{path}: {name}.{key}", "a list", repr(value))
    for key, field in fields.items():
        if field.default is dataclasses.MISSING and key not in values:
            raise UsageError(f"{path}: {name}.{key}", "a value", "none")
    return kind(**{k: tuple(v) if isinstance(v, list) else v for k, v in values.items()})


def _check(path: Any, robot: RobotFile) -> None:
    arm, place = robot.arm, robot.trocar.position
    rows = [
        ("arm.command", arm.command in ("servo_jp", "servo_cp"), "servo_jp or servo_cp"),
        ("arm.frame", bool(arm.frame), "the name of a frame, or view"),
        ("arm.instrument", arm.instrument in INSTRUMENTS, ", ".join(INSTRUMENTS)),
        ("arm.position", _is_point(arm.position), "x, y, z in m"),
        ("arm.quaternion_xyzw", _is_unit(arm.quaternion_xyzw), "x, y, z, w of length 1"),
        ("arm.open", arm.open > arm.closed, "more than arm.closed, rad"),
        ("arm.rate", 30.0 <= arm.rate <= 500.0, "30 to 500 Hz"),
        ("trocar.position", not place or _is_point(place), "x, y, z in m"),
    ]
    rows += [
        (f"limits.{name}", 0.0 < value < np.inf, "more than 0")
        for name, value in dataclasses.asdict(robot.limits).items()
    ]
    for name, holds, expected in rows:
        if not holds:
            table, field = name.split(".")
            got = getattr(getattr(robot, table), field)
            raise UsageError(f"{path}: {name}", expected, repr(got))


def _is_point(values: Any) -> bool:
    return len(values) == 3 and bool(np.isfinite(values).all()) and max(map(abs, values)) < 10.0


def _is_unit(values: Any) -> bool:
    return len(values) == 4 and bool(abs(np.linalg.norm(values) - 1.0) < 1e-3)
