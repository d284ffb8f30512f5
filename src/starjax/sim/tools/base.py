"""Tools: data beyond the MJCF."""

from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:  # it imports jax
    from starjax import rcm


class Tool(NamedTuple):
    """One tool, a row of the registry.

    Attributes:
      name: key in the registry.
      mjcf: a part below `mjcf/`, or the path of a file.
      tcp: site of the tip, {E}.
      jaw: joint that measures the opening, or None for a tool without jaws.
      servo: actuator of the jaws, or None.
      closed, open: m (rad if they turn) per jaw at gripper -1 (past closed, for a squeezing force)
        and +1.
      pads: geoms that grasp.
      is_symmetric: True if half a turn about its axis changes nothing.
      shaft_radius: m.
      shaft_end: m, the shaft's lower end lies this far before `base`.
      pad_end: m, the pads' ends lie this far past the tcp.
      shaft_reach: m of shaft above its end that can touch objects on the table.
      wrist: sizes and limits, or None for a straight tool. The fields below are a wrist's.
      shaft: site on its pitch axis, {L}.
      wrist_joints: names of pitch and yaw, each with a servo of its name.
      wrist_speed: rad/s of each, at most.
      palm_radius: m, of everything from the pitch axis to the jaws.
      version: raised with a change that makes it grasp or move otherwise.
    """

    name: str
    mjcf: str
    tcp: str
    jaw: str | None
    servo: str | None
    closed: float
    open: float
    pads: tuple[str, ...]
    is_symmetric: bool
    shaft_radius: float
    shaft_end: float
    pad_end: float
    shaft_reach: float
    wrist: "rcm.Wrist | None" = None
    shaft: str = ""
    wrist_joints: tuple[str, ...] = ()
    wrist_speed: float = 0.0
    palm_radius: float = 0.0
    version: int = 1

    @property
    def base(self) -> str:
        """Site that the arm carries: of the shaft before a wrist, else of the tip."""
        return self.shaft or self.tcp
