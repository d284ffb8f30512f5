"""Kinematics of the dVRK's patient side manipulator with an instrument, in closed form both ways.

Joints as CRTK's messages have them: yaw, pitch (rad), insertion (m), roll, wrist pitch, wrist yaw
(rad). The base frame is the manipulator's own, its origin the remote centre. Numpy in double
precision, one configuration at a time.

The pitch axis must lie below the remote centre: with the needle driver from 15.6 mm of insertion
on. Above it a tip has other joints than `joints_of` gives.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from starjax import rcm
from starjax.addons.robots.crtk import compose
from starjax.core.errors import UsageError
from starjax.core.types import Pose

JOINTS = (
    "outer_yaw",
    "outer_pitch",
    "outer_insertion",
    "outer_roll",
    "outer_wrist_pitch",
    "outer_wrist_yaw",
)
# The same joints as the dVRK's simulators and cisst's generic bridge name them.
NAMES = (
    JOINTS,
    ("yaw", "pitch", "insertion", "roll", "wrist_pitch", "wrist_yaw"),
    ("0", "1", "2", "3", "4", "5"),
)
# rad and m: limits of the dVRK's PSM and its instruments (kinematic/psm.json, share/tool).
LIMITS = np.array(
    [[-1.5882, 1.5882], [-0.925, 0.925], [0.0, 0.24], [-4.5379, 4.5379]] + [[-1.3963, 1.3963]] * 2
)
# Beyond these a joint is in degrees or mm: wider than the limits of any such arm.
_RANGES = np.array([[-np.pi, np.pi]] * 2 + [[-0.05, 0.4], [-2 * np.pi, 2 * np.pi]] + [[-2, 2]] * 2)
_FARTHEST = 0.5  # m, from the remote centre to a tip
_MAX_SKEW = 1e-3  # deviation of a matrix from a rotation
_TINY = 1e-12
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
      UsageError: another number of joints, or one that no arm has, as in degrees or mm.
    """
    yaw, pitch, insertion, roll = _joints(q)[:4]
    R_base_arm = Rotation.from_euler("YXZ", [-yaw, -pitch, -roll]).as_matrix()
    R = R_base_arm @ _R_BASE_SHAFT
    return Pose(R, (insertion + instrument.depth) * R[:, 2])


def tip_of(q: np.ndarray, instrument: Instrument) -> Pose:
    """Returns pose_base_tip of the joints `[6]`.

    Raises:
      UsageError: another number of joints, or one that no arm has, as in degrees or mm.
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

    Raises:
      UsageError: the pose is not finite, no rotation, or not in m.
    """
    R_tip, p_tip = (np.asarray(x, np.float64) for x in pose_base_tip)
    if R_tip.shape != (3, 3) or p_tip.shape != (3,):
        got = f"{list(R_tip.shape)}, {list(p_tip.shape)}"
        raise UsageError("pose_base_tip", "R [3, 3] and p [3]", got)
    if not np.abs(R_tip.T @ R_tip - np.eye(3)).max() < _MAX_SKEW or np.linalg.det(R_tip) < 0.0:
        raise UsageError("pose_base_tip.R", "a rotation", R_tip.tolist())
    if not np.linalg.norm(p_tip) <= _FARTHEST:
        expected = f"a tip in m, within {_FARTHEST} m of the remote centre"
        raise UsageError("pose_base_tip.p", expected, p_tip.tolist())
    wrist = instrument.wrist
    angles = _angles(R_tip, p_tip, wrist)
    bend = Rotation.from_euler("YX", angles).as_matrix()
    R = R_tip @ bend.T
    pitch_axis = (
        p_tip
        - wrist.jaws * R_tip[:, 2]
        - wrist.clevis
        * R
        @ [
            np.sin(angles[0]),
            0.0,
            np.cos(angles[0]),
        ]
    )
    x, y, z = R[:, 2]
    yaw, pitch = np.arctan2(x, -z), np.arctan2(-y, np.hypot(x, z))
    R_arm = Rotation.from_euler("YX", [-yaw, -pitch]).as_matrix()
    R_roll = R_arm.T @ R @ _R_BASE_SHAFT.T
    roll = -np.arctan2(R_roll[1, 0], R_roll[0, 0])
    insertion = float(pitch_axis @ R[:, 2]) - instrument.depth
    return np.array([yaw, pitch, insertion, roll, *angles])


def _angles(R: np.ndarray, p: np.ndarray, wrist: rcm.Wrist) -> np.ndarray:
    """Returns `rcm.angles_through` of the remote centre in double precision, `[2]` rad."""
    x, y, z = R.T
    yaw_axis = p - wrist.jaws * z
    along = yaw_axis @ x
    across = yaw_axis - along * x
    length = np.linalg.norm(across)
    clevis = across / length if length > _TINY else z
    return np.array([np.arctan2(-along, length - wrist.clevis), np.arctan2(clevis @ y, clevis @ z)])


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
    low, high = _RANGES.T
    if not ((q >= low) & (q <= high)).all():
        raise UsageError("q", "joints in rad and m, in the order of JOINTS", q.tolist())
    return q
