"""Workspaces: regions of one arm's trocar and tip, for which mounts are searched and tested."""

import math
from typing import NamedTuple

from starjax.rcm import trocar
from starjax.sim import endoscope_camera


class Workspace(NamedTuple):
    """A region of trocars and targets, a row of the registry.

    Attributes:
      p_world_ref: `(3,)` m, nominal trocar o_ref.
      radius, polar, azimuth: ranges of the trocar about the nominal one (Eq. 19), m and rad.
      low, high: `(3,)` m, the box of the tip.
      rolls: range, rad from `roll_zero`.
      roll_zero: rad, see `rcm.TrocarFrame`.
      base_low, base_high: `(3,)` m, the box in which an arm's base may stand.
    """

    p_world_ref: tuple[float, float, float]
    radius: trocar.Range
    polar: trocar.Range
    azimuth: trocar.Range
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    rolls: tuple[float, float]
    roll_zero: float
    base_low: tuple[float, float, float]
    base_high: tuple[float, float, float]


# A board, from a grasp on it to the start above it; the camera looks on from x > 0.
BOARD = Workspace(
    p_world_ref=(0.0, 0.0, 0.15),
    radius=trocar.RADIUS_RANGE,
    polar=trocar.POLAR_RANGE,
    azimuth=trocar.AZIMUTH_RANGE,
    low=(-0.045, -0.033, 0.006),
    high=(0.045, 0.033, 0.045),
    rolls=(-1.4, 1.4),
    roll_zero=0.0,
    base_low=(-0.8, -0.3, -0.4),
    base_high=(-0.2, 0.3, 1.2),
)


# The endoscope over the boards, opposite the arm. Nearer than 8 cm, pegs are out of the picture.
BOARD_ENDOSCOPE = endoscope_camera.Endoscope(
    p_world_ref=(0.15, 0.0, 0.15),
    radius=(0.0, 0.03),
    polar=trocar.POLAR_RANGE,
    azimuth=trocar.AZIMUTH_RANGE,
    work=(0.0, 0.0, 0.008),
    spread=(0.006, 0.006, 0.003),
    distance=(0.08, 0.11),
    up=(-1.0, 0.0, 0.0),
    fovy=70.0,
)
# The wire is longer than the boards, and higher.
WIRE_ENDOSCOPE = BOARD_ENDOSCOPE._replace(work=(0.0, 0.0, 0.03), distance=(0.09, 0.11))
# Perpendicular to two arms, which stand along x; they pass objects above the board.
SIDE_ENDOSCOPE = BOARD_ENDOSCOPE._replace(
    p_world_ref=(0.0, -0.15, 0.15), work=(0.0, 0.0, 0.02), up=(0.0, 1.0, 0.0)
)


# Two arms at either side, their rolls' zeros half a turn apart. Each trocar varies by 3 cm along x
# and 4.3 cm along y; see `tasks.two_arms` for their pairs.
LEFT = BOARD._replace(
    radius=(0.054, 0.084),
    polar=(math.radians(87), math.radians(93)),
    azimuth=(math.radians(165), math.radians(195)),
)
RIGHT = LEFT._replace(
    azimuth=(math.radians(-15), math.radians(15)),
    roll_zero=math.pi,
    base_low=(0.2, -0.3, -0.4),
    base_high=(0.8, 0.3, 1.2),
)

# Region of the lens of an endoscope that looks down on a target from 6 cm; its trocar is higher.
TISSUE = BOARD._replace(
    p_world_ref=(0.0, 0.0, 0.18),
    low=(-0.05, -0.028, 0.062),
    high=(0.032, 0.028, 0.094),
    rolls=(-0.3, 0.3),
)

# Region of a tool that holds a ring by its tab, on a wire along y.
WIRE = BOARD._replace(
    low=(-0.012, -0.045, 0.026),
    high=(0.012, 0.045, 0.066),
    rolls=(-1.0, 1.0),
)
