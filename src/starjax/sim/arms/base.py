"""Arms and their mounts: data beyond the MJCF."""

import math
from collections.abc import Mapping
from typing import NamedTuple


class Mount(NamedTuple):
    """Placement of an arm with a tool in a workspace; from `starjax find-mount`, tested.

    Attributes:
      position: `(3,)` m, of the arm's base in the world; for a remote centre from the trocar.
      yaw: rad, of the base about the world's z axis.
      turn: rad, of the tool about the flange's z axis.
      home: rad (m for a slide) per joint, where inverse kinematics starts and redundant joints
        return.
      tilt: rad, of the base about its own y axis, after the yaw: pi/2 on a wall, pi hanging.
    """

    position: tuple[float, float, float]
    yaw: float
    turn: float
    home: tuple[float, ...]
    tilt: float = 0.0

    @property
    def wxyz_base(self) -> tuple[float, float, float, float]:
        """Orientation of the base in the world, a quaternion."""
        (c, s), (a, b) = ((math.cos(v / 2), math.sin(v / 2)) for v in (self.yaw, self.tilt))
        return (c * a, -s * b, c * b, s * a)


def opposite(mount: Mount) -> Mount:
    """Returns the mount half a turn about the world's z axis away, for the opposite workspace."""
    x, y, z = mount.position
    yaw = math.remainder(mount.yaw + math.pi, 2 * math.pi)
    return mount._replace(position=(-x, -y, z), yaw=yaw)


def mounts(
    board: Mount,
    tissue: Mount,
    *,
    wrist: Mount | None = None,
    wire: Mount | None = None,
    left: Mount | None = None,
    right: Mount | None = None,
) -> dict[tuple[str, str], Mount]:
    """Returns `Arm.mounts` of an arm that serves every workspace.

    Args:
      board: mount for straight tools, and in place of those that are not passed.
      tissue: mount for endoscopes.
      wrist: mount for tools with a wrist at the board.
      wire: mount at the wire.
      left, right: mounts at either side of the board; the right one is opposite the left one.
    """
    left = left or board
    sides = {"left": left, "right": right or opposite(left)}
    return {
        ("grasper", "board"): board,
        **dict.fromkeys([("needle_driver", "board"), ("prograsp", "board")], wrist or board),
        ("grasper_wide", "wire"): wire or board,
        **{(tool, side): sides[side] for side in sides for tool in ("grasper", "needle_driver")},
        **dict.fromkeys([("endoscope", "tissue"), ("endoscope30", "tissue")], tissue),
    }


class Arm(NamedTuple):
    """One arm, a row of the registry.

    Attributes:
      name: key in the registry.
      mjcf: a part below `mjcf/`, or the path of a file; it ends in the site `flange`.
      first: its first moving body.
      joints: names from the base on; every one has a position servo of the same name.
      max_speed: rad/s (m/s for a slide) per joint.
      servo_frequency: rad/s, natural frequency of its critically damped joint servos.
      mounts: (tool, workspace) -> Mount.
      rest_gain: fraction of the way home that redundant joints take per iteration of inverse
        kinematics; 0 for up to six joints.
      link_radius: m, of its links, for the collision watch.
      watched: the first joint whose origin must stay above the table.
      version: raised with a change that moves it otherwise, such as of a mount.
      remote_centre: True for a mechanical remote centre, whose base stands at the trocar.
    """

    name: str
    mjcf: str
    first: str
    joints: tuple[str, ...]
    max_speed: tuple[float, ...]
    servo_frequency: float
    mounts: Mapping[tuple[str, str], Mount]
    rest_gain: float = 0.0
    link_radius: float = 0.05
    watched: int = 2
    remote_centre: bool = False
    version: int = 1
