"""Kinematics of the dVRK's patient side manipulator with an instrument, in closed form both ways.

Joints as CRTK's messages have them: yaw, pitch (rad), insertion (m), roll, wrist pitch, wrist yaw
(rad). The base frame is the manipulator's own, its origin the remote centre. Numpy in double
precision, one configuration at a time.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from starjax import rcm
from starjax.addons.robots.crtk import compose
from starjax.errors import UsageError
from starjax.types import Pose

JOINTS = (
    "outer_yaw",
    "outer_pitch",
    "outer_insertion",
    "outer_roll",
    "outer_wrist_pitch",
    "outer_wrist_yaw",
)
# The shaft's frame at zero in the base frame: its z points down.
_R_BASE_SHAFT = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])


class Instrument(NamedTuple):
    """An instrument on the manipulator.

    Attributes:
      wrist: sizes and limits.
      depth: m, of the pitch axis below the remote centre without insertion; negative above it.
    """

    wrist: rcm.Wrist
    depth: float


# Depths: offset of the roll's frame (share/tool/*.json of jhu-dvrk/sawIntuitiveResearchKit) less
# 0.4318 m of insertion (share/kinematic/psm.json).
LARGE_NEEDLE_DRIVER = Instrument(rcm.LARGE_NEEDLE_DRIVER, 0.4162 - 0.4318)
PROGRASP = Instrument(rcm.PROGRASP, 0.4670 - 0.4318)


def shaft_of(q: np.ndarray, instrument: Instrument) -> Pose:
    """Returns pose_base_shaft of the joints `[6]`; its origin is on the pitch axis.

    Raises:
      UsageError: another number of joints.
    """
    yaw, pitch, insertion, roll = _joints(q)[:4]
    R_base_arm = Rotation.from_euler("YXZ", [-yaw, -pitch, -roll]).as_matrix()
    R = R_base_arm @ _R_BASE_SHAFT
    return Pose(R, (insertion + instrument.depth) * R[:, 2])


def tip_of(q: np.ndarray, instrument: Instrument) -> Pose:
    """Returns pose_base_tip of the joints `[6]`.

    Raises:
      UsageError: another number of joints.
    """
    pitch, yaw = _joints(q)[4:]
    bend = Rotation.from_euler("Y", pitch), Rotation.from_euler("YX", [pitch, yaw])
    clevis, tip = (rotation.as_matrix() for rotation in bend)
    wrist = instrument.wrist
    p = wrist.clevis * clevis[:, 2] + wrist.jaws * tip[:, 2]
    return compose(shaft_of(q, instrument), Pose(tip, p))


def joints_of(pose_base_tip: Pose, instrument: Instrument) -> np.ndarray:
    """Returns the joints `[6]` of a tip pose: all of them exist, limits are the caller's.

    The other posture of symmetric jaws is `half_turn`.
    """
    wrist = instrument.wrist
    angles = np.asarray(rcm.angles_through(wrist, pose_base_tip, np.zeros(3)), np.float64)
    shaft = rcm.shaft_of(wrist, pose_base_tip, angles)
    R, p = (np.asarray(x, np.float64) for x in shaft)
    x, y, z = R[:, 2]
    yaw, pitch = np.arctan2(x, -z), np.arctan2(-y, np.hypot(x, z))
    R_arm = Rotation.from_euler("YX", [-yaw, -pitch]).as_matrix()
    R_roll = R_arm.T @ R @ _R_BASE_SHAFT.T
    roll = -np.arctan2(R_roll[1, 0], R_roll[0, 0])
    insertion = float(p @ R[:, 2]) - instrument.depth
    return np.array([yaw, pitch, insertion, roll, *angles])


def half_turn(q: np.ndarray) -> np.ndarray:
    """Returns the joints `[6]` whose tip is turned by half a turn about its own z axis."""
    yaw, pitch, insertion, roll, wrist_pitch, wrist_yaw = _joints(q)
    other = roll - np.copysign(np.pi, roll)
    return np.array([yaw, pitch, insertion, other, -wrist_pitch, -wrist_yaw])


def _joints(q: np.ndarray) -> np.ndarray:
    q = np.asarray(q, np.float64)
    if q.shape != (len(JOINTS),):
        raise UsageError(
            "q", f"shape [{len(JOINTS)}]", list(q.shape), "one configuration at a time"
        )
    return q
