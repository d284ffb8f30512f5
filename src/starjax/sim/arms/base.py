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
