"""Messages of CRTK, the ROS convention of dVRK and other surgical robots, as our structs.

Pure functions: they read messages by attribute and fill them in place, without importing ROS. The
ROS path is untested. CRTK uses SI units and quaternions x y z w.

    measured_cp       measured tip                 `pose_of`     -> Observation.pose
    jaw/measured_js   measured angle of the jaws   `opening_of`  -> Observation.gripper
    operating_state   permission to move           `is_ready`
    servo_cp          target tip                   `fill_pose`   <- Command.pose
    jaw/servo_jp      target angle of the jaws     `fill_jaw`    <- Command.gripper
    measured_js       measured joints              `joints_of`   -> as `addons.robots.psm` has them
    servo_jp          target joints                `fill_joints` <- as `addons.robots.psm` has them

`setpoint_cp`, the robot's last target tip, has the form of `measured_cp`. On a dVRK with an
endoscope `measured_cp`, `setpoint_cp` and `servo_cp` are relative to it, and only
`local/measured_cp` to the arm's remote centre: `pose_view_base` is between the two.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jax.typing import ArrayLike
from scipy.spatial.transform import Rotation

from starjax import rcm
from starjax.core.errors import UsageError
from starjax.core.types import Pose

_MAX_NORM_ERROR = 1e-3  # deviation of a quaternion's length from one


class Frames(NamedTuple):
    """Transforms from a robot's frames to ours; measure both, because neither is the identity.

    Attributes:
      pose_world_base: base frame of the robot's poses, in the policy's world.
      pose_tool_tip: the policy's tip in the frame that the robot reports: z along the shaft, out
        of the jaws, y in the direction of their opening.
      frame_id: name of the base frame in headers, e.g. `PSM1_base`. Empty it means the endoscope on
        a dVRK, so `fill_pose` refuses that.
    """

    pose_world_base: Pose
    pose_tool_tip: Pose
    frame_id: str = ""


class Jaw(NamedTuple):
    """Angles between the jaws, rad.

    Attributes:
      closed: for a firm grasp, often below 0.
      open: as in the demonstrations.
    """

    closed: float
    open: float


def pose_of(message: Any, frames: Frames) -> Pose:
    """Returns pose_world_tip of `measured_cp`, a PoseStamped, TransformStamped, Pose or Transform.

    Raises:
      UsageError: a value is not finite, the quaternion is not of unit length, or the header names
        another frame than `frames`.
    """
    header = getattr(message, "header", None)
    if header is not None and frames.frame_id and header.frame_id != frames.frame_id:
        expected, got = f"frame {frames.frame_id}", header.frame_id or "none: that of an endoscope"
        raise UsageError("measured_cp.header.frame_id", expected, got, "local/measured_cp has it")
    position, quaternion = _parts(message)
    p = _finite("measured_cp.position", [position.x, position.y, position.z])
    xyzw = np.array([quaternion.x, quaternion.y, quaternion.z, quaternion.w], np.float64)
    if not abs(np.linalg.norm(xyzw) - 1.0) < _MAX_NORM_ERROR:
        raise UsageError("measured_cp.orientation", "a unit quaternion", xyzw.tolist())
    pose_base_tool = _pose(Rotation.from_quat(xyzw).as_matrix(), p)
    return compose(compose(frames.pose_world_base, pose_base_tool), frames.pose_tool_tip)


def fill_pose(message: Any, pose_world_tip: Pose, frames: Frames) -> Any:
    """Fills `servo_cp`, a message as in `pose_of`, with the name of its frame, and returns it.

    Raises:
      UsageError: a value is not finite, R is no rotation, or a header would stay without a frame;
        the message is unchanged.
    """
    R = np.asarray(pose_world_tip.R, np.float64)
    if not np.abs(R.T @ R - np.eye(3)).max() < _MAX_NORM_ERROR or np.linalg.det(R) < 0.0:
        raise UsageError("servo_cp.orientation", "a rotation", R.tolist())
    _finite("servo_cp.position", pose_world_tip.p)
    header = getattr(message, "header", None)
    if header is not None:
        if not (frames.frame_id or header.frame_id):
            hint = "a dVRK reads none as the endoscope's"
            raise UsageError("frames.frame_id", "the name of the base frame", "none", hint)
        header.frame_id = frames.frame_id or header.frame_id
    pose_world_tool = compose(pose_world_tip, inverse(frames.pose_tool_tip))
    pose = compose(inverse(frames.pose_world_base), pose_world_tool)
    position, quaternion = _parts(message)
    x, y, z, w = Rotation.from_matrix(np.asarray(pose.R, np.float64)).as_quat(canonical=True)
    quaternion.x, quaternion.y, quaternion.z, quaternion.w = map(float, (x, y, z, w))
    position.x, position.y, position.z = map(float, pose.p)
    return message


def pose_of_arrays(R: Any, p: Any) -> Pose:
    """Returns the pose of a rotation `[3, 3]` and a position `[3]` m of NumPy."""
    return Pose(R, p)


def pose_view_base(measured_cp: Any, local_measured_cp: Any) -> Pose:
    """Returns the pose of a dVRK arm's base in its endoscope, of two messages of one moment."""
    identity = pose_of_arrays(np.eye(3), np.zeros(3))
    tool = Frames(identity, identity)
    return compose(pose_of(measured_cp, tool), inverse(pose_of(local_measured_cp, tool)))


def stamp_of(message: Any) -> float:
    """Returns the header's time in s, for `Observation.stamp`."""
    return message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec


def opening_of(message: Any, jaw: Jaw) -> float:
    """Returns the gripper's opening in [-1, 1] of `jaw/measured_js`, a JointState.

    Raises:
      UsageError: the message has no single finite angle.
    """
    positions = list(message.position)
    if len(positions) != 1 or not np.isfinite(positions[0]):
        raise UsageError("jaw/measured_js.position", "one finite angle", positions)
    fraction = (positions[0] - jaw.closed) / _range(jaw)
    return float(np.clip(2.0 * fraction - 1.0, -1.0, 1.0))


def fill_jaw(message: Any, gripper: float, jaw: Jaw) -> Any:
    """Fills `jaw/servo_jp`, a JointState, and returns it.

    Raises:
      UsageError: the opening is not finite.
    """
    _finite("gripper", gripper)
    fraction = (np.clip(gripper, -1.0, 1.0) + 1.0) / 2.0
    message.position = [float(jaw.closed + fraction * _range(jaw))]
    return message


def tool_tip(wrist: rcm.Wrist) -> Pose:
    """Returns pose_tool_tip of a dVRK's instrument for `Frames`.

    The dVRK's own frame lies on the yaw axis, half a turn about z from ours.
    """
    return _pose(np.diag([-1.0, -1.0, 1.0]), np.array([0.0, 0.0, wrist.jaws]))


def joints_of(message: Any, names: Sequence[str]) -> np.ndarray:
    """Returns the positions `[J]` (rad, m) of `measured_js`, a JointState, in the order of names.

    Raises:
      UsageError: a joint is missing, or a position is not finite.
    """
    if len(message.name) != len(message.position):
        expected = f"{len(message.name)} values, as names"
        raise UsageError("measured_js.position", expected, list(message.position))
    positions = dict(zip(message.name, message.position, strict=True))
    missing = [name for name in names if name not in positions]
    if missing:
        raise UsageError("measured_js.name", ", ".join(names), ", ".join(message.name) or "none")
    return _finite("measured_js.position", [positions[name] for name in names])


def fill_joints(message: Any, q: ArrayLike, names: Sequence[str]) -> Any:
    """Fills `servo_jp`, a JointState, with positions `[J]` (rad, m), and returns it.

    Raises:
      UsageError: another number of positions, or one that is not finite.
    """
    positions = _finite("servo_jp.position", q).tolist()
    if len(positions) != len(names):
        raise UsageError("servo_jp.position", f"{len(names)} values", positions)
    message.name, message.position = list(names), positions
    return message


def names_of(message: Any, sets: Sequence[Sequence[str]]) -> Sequence[str]:
    """Returns the set of names that `measured_js` has, for `joints_of` and `fill_joints`.

    Raises:
      UsageError: it lacks a name of each.
    """
    for names in sets:
        if set(names) <= set(message.name):
            return names
    expected = " or ".join(", ".join(names) for names in sets)
    raise UsageError("measured_js.name", expected, ", ".join(message.name) or "none")


def is_ready(message: Any) -> bool:
    """Returns True if `operating_state` permits motion: enabled, homed and not busy."""
    return message.state == "ENABLED" and bool(message.is_homed) and not message.is_busy


def compose(pose_a_b: Pose, pose_b_c: Pose) -> Pose:
    """Returns pose_a_c."""
    R, p = (np.asarray(x, np.float64) for x in pose_a_b)
    return _pose(R @ np.asarray(pose_b_c.R), R @ np.asarray(pose_b_c.p) + p)


def inverse(pose_a_b: Pose) -> Pose:
    """Returns pose_b_a."""
    R, p = (np.asarray(x, np.float64) for x in pose_a_b)
    return _pose(R.T, -R.T @ p)


def _range(jaw: Jaw) -> float:
    if not jaw.open > jaw.closed:
        raise UsageError("jaw.open", f"more than jaw.closed, {jaw.closed:g} rad", jaw.open)
    return jaw.open - jaw.closed


def _finite(argument: str, values: ArrayLike | list[float]) -> np.ndarray:
    values = np.asarray(values, np.float64)
    if not np.isfinite(values).all():
        raise UsageError(argument, "finite values", values.tolist())
    return values


def _parts(message: Any) -> tuple[Any, Any]:
    """Returns position and quaternion of a Pose or a Transform, stamped or not."""
    part = getattr(message, "pose", None) or getattr(message, "transform", None) or message
    if hasattr(part, "translation"):
        return part.translation, part.rotation
    return part.position, part.orientation


def _pose(R: Any, p: Any) -> Pose:
    return Pose(R, p)
