"""A mechanical remote centre, as of the dVRK's manipulator with its wrist locked: four joints.

Its shaft cannot leave the trocar: the bound that other arms' RCM errors are compared with. What is
commanded off the RCM manifold it does not follow.
"""

import math

from starjax.sim.arms.base import Arm, Mount, mounts

# Yaw turns about the world's y axis, where the shaft leans furthest.
_BOARD = Mount(position=(0.0, 0.0, 0.0), yaw=-math.pi / 2, turn=0.0, home=(0.0, 0.0, 0.11, 0.0))
_WRIST = _BOARD._replace(yaw=_BOARD.yaw - 0.2)  # bent tools lean further
_LEFT = Mount(position=(0.0, 0.0, 0.0), yaw=-1.522, turn=0.044, home=(0.432, 0.02, 0.122, 0.0))

_WIRE = Mount(
    position=(0.0, 0.0, 0.0),
    yaw=2.979,
    turn=2.297,
    home=(0.0, 0.0, 0.089, 2.253),
)
_TISSUE = Mount(
    position=(0.0, 0.0, 0.0),
    yaw=-1.571,
    turn=2.534,
    home=(-0.088, 0.0, 0.087, -2.534),
)

ARM = Arm(
    name="rcm4",
    mjcf="arms/rcm4/rcm4.xml",
    first="yaw",
    joints=("yaw", "pitch", "insertion", "roll"),
    max_speed=(1.0, 1.0, 0.2, 8.0),  # as in published work with the dVRK
    servo_frequency=100.0,
    mounts=mounts(_BOARD, _TISSUE, wrist=_WRIST, wire=_WIRE, left=_LEFT),
    link_radius=0.02,
    remote_centre=True,
)
