"""Messages of ROS 2 as its DDS has them: types in plain CDR, without ROS.

On the wire a topic `/PSM1/servo_cp` of `geometry_msgs/msg/PoseStamped` is `rt/PSM1/servo_cp` of
`geometry_msgs::msg::dds_::PoseStamped_`. Names, order and types of the fields are the layout: a
test decodes and encodes each type by `rosbags`. All types are final; ROS matches no others.
"""

# pyright: reportAssignmentType=false
# cyclonedds declares sequences by a type of its own, and takes lists and bytes.

import time
from dataclasses import dataclass, field

from cyclonedds.idl import IdlStruct
from cyclonedds.idl._machinery import BytesMachine  # private; a test fails if it moves
from cyclonedds.idl.annotations import final
from cyclonedds.idl.types import float64, int32, sequence, uint8, uint32


@dataclass
@final
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    """A time in s and ns."""

    sec: int32 = 0
    nanosec: uint32 = 0


@dataclass
@final
class Duration(IdlStruct, typename="builtin_interfaces::msg::dds_::Duration_"):
    """A time between two in s and ns."""

    sec: int32 = 0
    nanosec: uint32 = 0


@dataclass
@final
class ClockMessage(IdlStruct, typename="rosgraph_msgs::msg::dds_::Clock_"):
    """The time of a simulator."""

    clock: Time = field(default_factory=Time)


@dataclass
@final
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    """Time and frame of a message."""

    stamp: Time = field(default_factory=Time)
    frame_id: str = ""


@dataclass
@final
class Empty(IdlStruct, typename="std_msgs::msg::dds_::Empty_"):
    """A signal, as `hold`."""

    structure_needs_at_least_one_member: uint8 = 0


@dataclass
@final
class Float64(IdlStruct, typename="std_msgs::msg::dds_::Float64_"):
    """A number."""

    data: float64 = 0.0


@dataclass
@final
class Point(IdlStruct, typename="geometry_msgs::msg::dds_::Point_"):
    """A position in m."""

    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0


@dataclass
@final
class Vector3(IdlStruct, typename="geometry_msgs::msg::dds_::Vector3_"):
    """A translation in m."""

    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0


@dataclass
@final
class Quaternion(IdlStruct, typename="geometry_msgs::msg::dds_::Quaternion_"):
    """A rotation."""

    x: float64 = 0.0
    y: float64 = 0.0
    z: float64 = 0.0
    w: float64 = 1.0


@dataclass
@final
class PoseMessage(IdlStruct, typename="geometry_msgs::msg::dds_::Pose_"):
    """A pose."""

    position: Point = field(default_factory=Point)
    orientation: Quaternion = field(default_factory=Quaternion)


@dataclass
@final
class Transform(IdlStruct, typename="geometry_msgs::msg::dds_::Transform_"):
    """A pose, as older CRTK has it."""

    translation: Vector3 = field(default_factory=Vector3)
    rotation: Quaternion = field(default_factory=Quaternion)


@dataclass
@final
class PoseStamped(IdlStruct, typename="geometry_msgs::msg::dds_::PoseStamped_"):
    """A pose with a header."""

    header: Header = field(default_factory=Header)
    pose: PoseMessage = field(default_factory=PoseMessage)


@dataclass
@final
class TransformStamped(IdlStruct, typename="geometry_msgs::msg::dds_::TransformStamped_"):
    """A transform with a header."""

    header: Header = field(default_factory=Header)
    child_frame_id: str = ""
    transform: Transform = field(default_factory=Transform)


@dataclass
@final
class PointStamped(IdlStruct, typename="geometry_msgs::msg::dds_::PointStamped_"):
    """A position with a header."""

    header: Header = field(default_factory=Header)
    point: Point = field(default_factory=Point)


@dataclass
@final
class Path(IdlStruct, typename="nav_msgs::msg::dds_::Path_"):
    """Poses one after another."""

    header: Header = field(default_factory=Header)
    poses: sequence[PoseStamped] = field(default_factory=list)


@dataclass
@final
class JointState(IdlStruct, typename="sensor_msgs::msg::dds_::JointState_"):
    """Joints by name, rad or m."""

    header: Header = field(default_factory=Header)
    name: sequence[str] = field(default_factory=list)
    position: sequence[float64] = field(default_factory=list)
    velocity: sequence[float64] = field(default_factory=list)
    effort: sequence[float64] = field(default_factory=list)


@dataclass
@final
class Image(IdlStruct, typename="sensor_msgs::msg::dds_::Image_"):
    """Pixels row by row."""

    header: Header = field(default_factory=Header)
    height: uint32 = 0
    width: uint32 = 0
    encoding: str = "rgb8"
    is_bigendian: uint8 = 0
    step: uint32 = 0
    data: sequence[uint8] = b""


@dataclass
@final
class CompressedImage(IdlStruct, typename="sensor_msgs::msg::dds_::CompressedImage_"):
    """A JPEG or PNG file."""

    header: Header = field(default_factory=Header)
    format: str = "jpeg"
    data: sequence[uint8] = b""


@dataclass
@final
class OperatingState(IdlStruct, typename="crtk_msgs::msg::dds_::OperatingState_"):
    """Permission to move."""

    header: Header = field(default_factory=Header)
    state: str = "DISABLED"
    is_homed: bool = False
    is_busy: bool = False


@dataclass
@final
class StringStamped(IdlStruct, typename="crtk_msgs::msg::dds_::StringStamped_"):
    """A text with a header."""

    header: Header = field(default_factory=Header)
    string: str = ""


# Hashes of the types' definitions (RIHS01 of REP-2016), without their prefix. Without them ROS 2
# warns once a topic.
_HASHES = {
    "crtk_msgs": {
        "OperatingState": "5cc57eea589b217fe5194bf2735b91d4a7f2dd5ac1245ae657f7ea7590c2c80e",
        "StringStamped": "83efb802e6596e03f69ac322e3231037329946f2bd13ed48874d97f5b8f5db1d",
    },
    "geometry_msgs": {
        "PoseStamped": "10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8",
        "TransformStamped": "0a241f87d04668d94099cbb5ba11691d5ad32c2f29682e4eb5653424bd275206",
        "PointStamped": "4c0296af86e01e562e9e0405d138a01537247580076c58ea38d7923ac1045897",
    },
    "nav_msgs": {
        "Path": "1957a5bb3cee5da65c4e52e52b65a93df227efce4c20f8458b36e73066ca334b",
    },
    "rosgraph_msgs": {
        "Clock": "692f7a66e93a3c83e71765d033b60349ba68023a8c689a79e48078bcb5c58564",
    },
    "sensor_msgs": {
        "JointState": "a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
        "Image": "d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47",
        "CompressedImage": "15640771531571185e2efc8a100baf923961a4d15d5569652e6cb6691e8e371a",
    },
    "std_msgs": {
        "Float64": "705ba9c3d1a09df43737eb67095534de36fd426c0587779bda2bc51fe790182a",
        "Empty": "20b625256f32d5dbc0d04fee44f43c41e51c70d3502f84b4a08e7a9c26a96312",
    },
    "visualization_msgs": {
        "MarkerArray": "86cb8800b6fb05b5eff1abd7a56f62a5641d3ae9a1c29e78e67e704f1d067dcf",
    },
}
HASHES = {f"{k}/msg/{name}": own for k, some in _HASHES.items() for name, own in some.items()}

# Lists of numbers would take 0.7 s for a picture of 1920 x 1080; bytes take 8 ms.
for _kind in (Image, CompressedImage):
    _kind.__idl__.populate()
    _kind.__idl__.v1_machine.members_machines["data"] = BytesMachine()


def stamp(seconds: float | None = None) -> Time:
    """Returns a time, by default now."""
    ns = time.time_ns() if seconds is None else round(1e9 * seconds)
    return Time(ns // 10**9, ns % 10**9)


def name_of(kind: type) -> str:
    """Returns the type of a message as ROS names it, `package/msg/Name`."""
    return ros_name(kind.__idl__.idl_transformed_typename)  # pyright: ignore


def type_hash(kind: type) -> str:
    """Returns the hash of a message's definition as ROS writes it."""
    return f"RIHS01_{HASHES[name_of(kind)]}"


def ros_name(typename: str) -> str:
    """Returns ROS's name of a type of DDS."""
    return typename.replace("::dds_::", "::").removesuffix("_").replace("::", "/")
