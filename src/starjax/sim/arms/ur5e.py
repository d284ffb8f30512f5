"""Universal Robots UR5e: six joints, 5 kg. Figures from the maker's pages."""

import math

from starjax.sim.arms.base import Arm, Mount, mounts

_MOUNT = Mount(
    position=(-0.566, 0.075, 0.409),
    yaw=0.826,
    turn=-3.12,
    home=(-0.722, 1.972, 1.911, -2.312, 1.571, 1.653),
)

_TISSUE = Mount(
    position=(-0.476, 0.231, 0.447),
    yaw=0.819,
    turn=-1.711,
    home=(-1.006, 1.98, 1.975, -2.471, 1.554, -0.046),
)
ARM = Arm(
    name="ur5e",
    mjcf="arms/ur5e/ur5e.xml",
    first="shoulder",
    joints=("j1", "j2", "j3", "j4", "j5", "j6"),
    max_speed=(math.pi,) * 6,
    servo_frequency=100.0,
    mounts=mounts(_MOUNT, _TISSUE),
)
