"""What an arm is, and where it stands: what its MJCF does not say. Data only."""

from collections.abc import Mapping
from typing import NamedTuple


class Mount(NamedTuple):
    """An arm with a tool in a workspace; found by `starjax place`, held by a test.

    Attributes:
      position: `(3,)` m, of the arm's base in the world.
      yaw: rad, of the base about the world's z axis.
      turn: rad, of the tool about the flange's z axis.
      home: rad (m for a slide), one a joint: where inverse kinematics starts, and what redundant
        joints return to.
    """

    position: tuple[float, float, float]
    yaw: float
    turn: float
    home: tuple[float, ...]


class Arm(NamedTuple):
    """One arm, a row of the registry.

    Attributes:
      name: key in the registry.
      mjcf: a part below `mjcf/`, or the path of a file; it ends in the site `flange`.
      first: its first moving body.
      joints: names from the base on; every one has a position servo of the same name.
      max_speed: rad/s (m/s for a slide), one a joint.
      servo_frequency: rad/s, natural frequency of its critically damped joint servos.
      mounts: (tool, workspace) -> Mount.
      rest_gain: share of the way home that joints beyond six take in an iteration of inverse
        kinematics; 0 without such joints.
      link_radius: m, of its links, for the collision watch.
      watched: the first joint whose origin must stay above the table.
      remote_centre: whether its base stands at the trocar, being a mechanical remote centre.
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
