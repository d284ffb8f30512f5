"""The description of a robot: a TOML file with its topics, frames, trocar and limits."""

import dataclasses
import json
import tomllib
from pathlib import Path
from typing import Any, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from starjax.addons.robots import crtk, kinematics
from starjax.addons.robots.crtk import Jaw
from starjax.addons.robots.kinematics import INSTRUMENTS, PSM
from starjax.core import errors
from starjax.core.errors import UsageError
from starjax.core.types import Pose

# CRTK's names in the arm's namespace.
TOPICS = {
    "pose": "local/measured_cp",
    "view": "measured_cp",
    "setpoint": "setpoint_cp",
    "joints": "measured_js",
    "joint_setpoint": "setpoint_js",
    "jaw": "jaw/measured_js",
    "state": "operating_state",
    "warning": "warning",
    "error": "error",
    "servo_cp": "servo_cp",
    "servo_jp": "servo_jp",
    "jaw_servo": "jaw/servo_jp",
    "hold": "hold",
}
VIEW = "view"  # the frame of commands relative to the endoscope


@dataclasses.dataclass(frozen=True)
class ArmTable:
    """Table `[arm]`.

    Attributes:
      namespace: of the arm's topics, e.g. `/PSM1`.
      kind: `psm`, or an arm of the registry that takes joints, e.g. `fr5`.
      command: `servo_jp`, joints by our inverse kinematics, or `servo_cp`, poses of a PSM.
      frame: name of the base frame, or `view`: `servo_cp` relative to the endoscope.
      instrument: of a PSM `large_needle_driver` or `prograsp`, of others a straight tool.
      task: whose mount of another arm has the tool's turn on the flange.
      closed, open: rad, angles of the jaws.
      position, quaternion_xyzw: of the base in the policy's world, m.
      rate: Hz, of the commands; a policy has 30 Hz, in between they are interpolated.
    """

    namespace: str
    kind: str = PSM
    command: str = "servo_jp"
    frame: str = "PSM1_base"
    instrument: str = "large_needle_driver"
    task: str = "peg_transfer"
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
    """Table `[camera.NAME]`: a topic of images, cropped to their middle square.

    Attributes:
      topic: of an Image; of a CompressedImage if it ends in `/compressed`.
    """

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
      use_sim_time: True for a simulator's time, its topic `/clock`.
    """

    domain: int = 0
    interface: str = ""
    peers: tuple[str, ...] = ()
    use_sim_time: bool = False


@dataclasses.dataclass(frozen=True)
class RobotFile:
    """A robot as its file describes it.

    Attributes:
      topics: name of `TOPICS` -> topic in place of CRTK's.
    """

    arm: ArmTable
    trocar: TrocarTable
    cameras: dict[str, CameraTable]
    limits: LimitsTable
    network: Network
    topics: dict[str, str] = dataclasses.field(default_factory=dict)

    def topic(self, name: str) -> str:
        """Returns the topic of a name of `TOPICS`."""
        return self.topics.get(name) or f"{self.arm.namespace}/{TOPICS[name]}"

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
    cameras, topics = tables.pop("camera", {}), tables.pop("topics", {})
    for name, topic in topics.items():
        errors.choice(f"{path}: topics.{name}", name, TOPICS)
        if not (isinstance(topic, str) and topic.startswith("/")):
            raise UsageError(f"{path}: topics.{name}", "a topic with a slash", repr(topic))
    kinds = {"arm": ArmTable, "trocar": TrocarTable, "limits": LimitsTable, "network": Network}
    for name in set(tables) - set(kinds):
        raise UsageError(
            f"{path}: {name}", f"one of {', '.join([*kinds, 'camera', 'topics'])}", "unknown"
        )
    parts = {name: _table(path, name, kind, tables.get(name, {})) for name, kind in kinds.items()}
    made = {name: _table(path, f"camera.{name}", CameraTable, row) for name, row in cameras.items()}
    robot = RobotFile(cameras=made, topics=topics, **parts)
    _check(path, robot)
    return robot


def text(robot: RobotFile) -> str:
    """Returns the TOML text of a robot's file."""
    tables = {
        name: dataclasses.asdict(getattr(robot, name))
        for name in ("arm", "trocar", "limits", "network")
    }
    tables |= {f"camera.{name}": dataclasses.asdict(row) for name, row in robot.cameras.items()}
    tables["topics"] = robot.topics
    lines = []
    for name, rows in tables.items():
        lines.append(f"[{name}]")
        # Strings, numbers, booleans and lists of numbers are alike in JSON.
        lines += [f"{key} = {json.dumps(value)}" for key, value in rows.items()]
    return "\n".join(lines) + "\n"


def _table(path: str | Path, name: str, kind: type, values: Any) -> Any:
    """Returns a table as its record, every value of the record's type."""
    fields = {field.name: field for field in dataclasses.fields(kind)}
    if not isinstance(values, dict):
        raise UsageError(f"{path}: {name}", "a table", type(values).__name__)
    for key, value in values.items():
        if key not in fields:
            raise UsageError(f"{path}: {name}.{key}", f"one of {', '.join(fields)}", "unknown")
        expected = {bool: "true or false", str: "text", int: "a whole number", float: "a number"}
        kinds: Any = (int, float) if fields[key].type is float else fields[key].type
        if fields[key].type in expected and (
            not isinstance(value, kinds) or isinstance(value, bool) is not (kinds is bool)
        ):
            raise UsageError(f"{path}: {name}.{key}", expected[fields[key].type], repr(value))
        for item in get_args(fields[key].type)[:1]:
            kinds, of = ((int, float), "numbers") if item is float else (item, "texts")
            if not (isinstance(value, list) and all(isinstance(x, kinds) for x in value)):
                raise UsageError(f"{path}: {name}.{key}", f"a list of {of}", repr(value))
    for key, field in fields.items():
        if field.default is dataclasses.MISSING and key not in values:
            raise UsageError(f"{path}: {name}.{key}", "a value", "none")
    return kind(**{k: tuple(v) if isinstance(v, list) else v for k, v in values.items()})


def _check(path: str | Path, robot: RobotFile) -> None:
    from starjax.sim import registries

    arm, place = robot.arm, robot.trocar.position
    is_psm, kinds = arm.kind == PSM, kinematics.kinds()
    instruments = list(INSTRUMENTS) if is_psm else registries.tools.names()
    rows = [
        ("arm.command", arm.command in ("servo_jp", "servo_cp"), "servo_jp or servo_cp"),
        ("arm.frame", bool(arm.frame), "the name of a frame, or view"),
        ("arm.kind", arm.kind in kinds, ", ".join(kinds)),
        ("arm.command", is_psm or arm.command == "servo_jp", f"servo_jp of {arm.kind}"),
        ("arm.instrument", arm.instrument in instruments, ", ".join(instruments)),
        ("arm.task", arm.task in registries.tasks.names(), ", ".join(registries.tasks.names())),
        ("arm.position", _is_point(arm.position), "x, y, z in m"),
        ("arm.quaternion_xyzw", _is_unit(arm.quaternion_xyzw), "x, y, z, w of length 1"),
        ("arm.open", arm.open > arm.closed, "more than arm.closed, rad"),
        ("arm.rate", 30.0 <= arm.rate <= 500.0, "30 to 500 Hz"),
        ("trocar.position", _is_point(place) if place else is_psm, "x, y, z in m"),
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
