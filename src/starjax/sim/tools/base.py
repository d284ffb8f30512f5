"""Tools: data beyond the MJCF."""

from typing import NamedTuple


class Tool(NamedTuple):
    """One tool, a row of the registry.

    Attributes:
      name: key in the registry.
      mjcf: a part below `mjcf/`, or the path of a file.
      tcp: site of the tip, {E}.
      jaw: joint that measures the opening, or None for a tool without jaws.
      servo: actuator of the jaws, or None.
      closed, open: m per jaw at gripper -1 (past closed, for a squeezing force) and +1.
      pads: geoms that grasp.
      is_symmetric: True if half a turn about its axis changes nothing.
      shaft_radius: m.
      shaft_end: m, the shaft's lower end lies this far before the tcp.
      pad_end: m, the pads' ends lie this far past the tcp.
      shaft_reach: m of shaft above its end that can touch objects on the table.
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
