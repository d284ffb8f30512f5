"""Markers of rviz: types of `visualization_msgs`, and the picture of a policy's work.

All are in the frame of the policy's world.
"""

# pyright: reportAssignmentType=false, reportArgumentType=false, reportCallIssue=false
# cyclonedds declares sequences by a type of its own, and takes lists and bytes.

from dataclasses import dataclass, field

import numpy as np
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.annotations import final
from cyclonedds.idl.types import float32, int32, sequence, uint8

from starjax.addons.robots.messages import (
    CompressedImage,
    Duration,
    Header,
    Point,
    PoseMessage,
    Vector3,
)

_SPHERE, _LINE, _TEXT = 2, 4, 9
_GREEN, _AMBER, _RED, _GREY = (0.1, 0.7, 0.3), (1.0, 0.7, 0.1), (0.9, 0.1, 0.1), (0.6, 0.6, 0.6)
_ABOVE = (0.0, 0.0, 0.03)  # m, of the text
WARNS_FROM = 0.001  # m of RCM error, beyond which the trocar turns red


@dataclass
@final
class Colour(IdlStruct, typename="std_msgs::msg::dds_::ColorRGBA_"):
    """A colour, in [0, 1]."""

    r: float32 = 0.0
    g: float32 = 0.0
    b: float32 = 0.0
    a: float32 = 1.0


@dataclass
@final
class UVCoordinate(IdlStruct, typename="visualization_msgs::msg::dds_::UVCoordinate_"):
    """A place in a texture."""

    u: float32 = 0.0
    v: float32 = 0.0


@dataclass
@final
class MeshFile(IdlStruct, typename="visualization_msgs::msg::dds_::MeshFile_"):
    """A mesh."""

    filename: str = ""
    data: sequence[uint8] = field(default_factory=list)


@dataclass
@final
class Marker(IdlStruct, typename="visualization_msgs::msg::dds_::Marker_"):
    """A shape for rviz: type 2 is a sphere, 4 a line, 9 a text; action 0 adds it."""

    header: Header = field(default_factory=Header)
    ns: str = "starjax"
    id: int32 = 0
    type: int32 = 0
    action: int32 = 0
    pose: PoseMessage = field(default_factory=PoseMessage)
    scale: Vector3 = field(default_factory=Vector3)
    color: Colour = field(default_factory=Colour)
    lifetime: Duration = field(default_factory=Duration)
    frame_locked: bool = False
    points: sequence[Point] = field(default_factory=list)
    colors: sequence[Colour] = field(default_factory=list)
    texture_resource: str = ""
    texture: CompressedImage = field(default_factory=CompressedImage)
    uv_coordinates: sequence[UVCoordinate] = field(default_factory=list)
    text: str = ""
    mesh_resource: str = ""
    mesh_file: MeshFile = field(default_factory=MeshFile)
    mesh_use_embedded_materials: bool = False


@dataclass
@final
class MarkerArray(IdlStruct, typename="visualization_msgs::msg::dds_::MarkerArray_"):
    """Shapes for rviz."""

    markers: sequence[Marker] = field(default_factory=list)


def of(
    header: Header,
    trocar: np.ndarray,
    tip: np.ndarray,
    plan: np.ndarray,
    rcm_error: float,
    text: str,
) -> MarkerArray:
    """Returns trocar, shaft, plan and a text above the trocar.

    Args:
      header: of all.
      trocar: `[3]` m. tip: `[3]` m, measured. plan: `[K, 3]` m, tips to come.
      rcm_error: m, of the measured shaft: it colours the trocar.
      text: state or alarm.
    """
    colour = _GREEN if rcm_error < WARNS_FROM else _RED
    rows = [
        (_SPHERE, 0.006, colour, [], trocar, ""),
        (_LINE, 0.002, _GREY, [trocar, tip], np.zeros(3), ""),
        (_LINE, 0.0015, _AMBER, list(plan) if len(plan) > 1 else [tip, tip], np.zeros(3), ""),
        (_TEXT, 0.01, _GREY, [], np.add(trocar, _ABOVE), f"{text}, {1e3 * rcm_error:.2f} mm"),
    ]
    return MarkerArray(
        [
            Marker(
                header,
                id=i,
                type=kind,
                pose=PoseMessage(_point(at)),
                scale=Vector3(size, size, size),
                color=Colour(*map(float, rgb)),
                points=[_point(p) for p in points],
                text=words,
            )
            for i, (kind, size, rgb, points, at, words) in enumerate(rows)
        ]
    )


def _point(p: np.ndarray) -> Point:
    return Point(*map(float, p))
