"""Fairino FR5: six joints, 5 kg. Figures from the maker's URDF and data sheet."""

import math

from starjax.sim.arms.base import Arm, Mount, mounts

_BOARD = Mount(
    position=(-0.58, 0.0, 0.20),
    yaw=math.pi,
    turn=-1.75,  # j6 stays far from its limits over all trocars
    home=(-0.18, -1.10, 1.90, -2.36, -1.571, 0.0),
)
_RIGHT = _BOARD._replace(position=(0.58, 0.0, 0.20), yaw=0.0)
_TISSUE = Mount(
    position=(-0.456, 0.237, -0.04),
    yaw=-2.238,
    turn=-1.587,
    home=(-1.55, -1.491, 1.572, -1.582, -1.624, -0.628),
)
ARM = Arm(
    name="fr5",
    mjcf="arms/fr5/fr5.xml",
    first="shoulder",
    joints=("j1", "j2", "j3", "j4", "j5", "j6"),
    max_speed=(3.15,) * 6,  # the slower joints of the data sheet
    servo_frequency=100.0,
    mounts=mounts(_BOARD, _TISSUE, right=_RIGHT),
)
