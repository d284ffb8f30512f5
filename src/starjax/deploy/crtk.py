"""Names of CRTK, which dVRK and other surgical robots speak over ROS, mapped to our structs.

Pure functions: messages are read by their attributes and filled in place, so ROS is not imported,
and nothing here has run with ROS. CRTK is in SI units; its quaternions are x y z w.

    measured_cp   tip that is measured           `pose_of`     -> Observation.pose
    jaw/measured_js   angle between the jaws     `opening_of`  -> Observation.gripper
    operating_state   may it be moved?           `is_ready`
    servo_cp      tip to be at now               `fill_pose`   <- Command.pose
    jaw/servo_jp  angle between the jaws to have `fill_jaw`    <- Command.gripper

`setpoint_cp`, the tip that the robot was last sent to, has the form of `measured_cp`.
"""

from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from starjax.errors import UsageError
from starjax.types import Pose

_LONGEST = 1e-3  # of a quaternion's length from one


class Frames(NamedTuple):
    """Where a robot's frames are; measure both, they are never the identity by luck.

    Attributes:
      pose_world_base: of the frame that the robot reports poses in, in the policy's world.
      pose_tool_tip: of the tip as the policy has it, in the frame that the robot reports: z along
        the shaft, out of the jaws, y in which they open.
    """

    pose_world_base: Pose
    pose_tool_tip: Pose


class Jaw(NamedTuple):
    """Angles between the jaws, rad.

    Attributes:
      closed: where a thing is held firmly, often below 0. open: as in the demonstrations.
    """

    closed: float
    open: float


def pose_of(message: Any, frames: Frames) -> Pose:
    """pose_world_tip of `measured_cp`, a PoseStamped or Pose.

    Raises:
      UsageError: a number is not finite, or the quaternion is none.
    """
    pose = getattr(message, "pose", message)
    position, wxyz = pose.position, pose.orientation
    p = np.array([position.x, position.y, position.z], np.float64)
    xyzw = np.array([wxyz.x, wxyz.y, wxyz.z, wxyz.w], np.float64)
    if not np.isfinite(p).all():
        raise UsageError("measured_cp.position", "finite numbers", p.tolist())
    if not abs(np.linalg.norm(xyzw) - 1.0) < _LONGEST:
        raise UsageError("measured_cp.orientation", "a unit quaternion", xyzw.tolist())
    measured = Pose(*_arrays(Rotation.from_quat(xyzw).as_matrix(), p))
    return compose(compose(frames.pose_world_base, measured), frames.pose_tool_tip)


def fill_pose(message: Any, pose_world_tip: Pose, frames: Frames) -> Any:
    """Fills `servo_cp`, a PoseStamped or Pose, and returns it; its header is the caller's."""
    tool = compose(pose_world_tip, inverse(frames.pose_tool_tip))
    pose = compose(inverse(frames.pose_world_base), tool)
    x, y, z, w = Rotation.from_matrix(np.asarray(pose.R, np.float64)).as_quat(canonical=True)
    part = getattr(message, "pose", message)
    part.orientation.x, part.orientation.y = float(x), float(y)
    part.orientation.z, part.orientation.w = float(z), float(w)
    part.position.x, part.position.y, part.position.z = map(float, pose.p)
    return message


def opening_of(message: Any, jaw: Jaw) -> float:
    """The gripper's opening in [-1, 1] of `jaw/measured_js`, a JointState.

    Raises:
      UsageError: it has no finite angle.
    """
    positions = list(message.position)
    if len(positions) != 1 or not np.isfinite(positions[0]):
        raise UsageError("jaw/measured_js.position", "one finite angle", positions)
    share = (positions[0] - jaw.closed) / (_checked(jaw).open - jaw.closed)
    return float(np.clip(2.0 * share - 1.0, -1.0, 1.0))


def fill_jaw(message: Any, gripper: float, jaw: Jaw) -> Any:
    """Fills `jaw/servo_jp`, a JointState, and returns it."""
    share = (np.clip(gripper, -1.0, 1.0) + 1.0) / 2.0
    message.position = [float(jaw.closed + share * (_checked(jaw).open - jaw.closed))]
    return message


def is_ready(message: Any) -> bool:
    """Whether `operating_state` lets the arm be moved: enabled, homed, and not busy."""
    return message.state == "ENABLED" and bool(message.is_homed) and not message.is_busy


def compose(pose_a_b: Pose, pose_b_c: Pose) -> Pose:
    """pose_a_c."""
    R, p = (np.asarray(x, np.float64) for x in pose_a_b)
    return Pose(*_arrays(R @ np.asarray(pose_b_c.R), R @ np.asarray(pose_b_c.p) + p))


def inverse(pose_a_b: Pose) -> Pose:
    """pose_b_a."""
    R, p = (np.asarray(x, np.float64) for x in pose_a_b)
    return Pose(*_arrays(R.T, -R.T @ p))


def _checked(jaw: Jaw) -> Jaw:
    if not jaw.open > jaw.closed:
        raise UsageError("jaw.open", f"more than jaw.closed, {jaw.closed:g} rad", jaw.open)
    return jaw


def _arrays(*values: Any) -> Any:
    return values
