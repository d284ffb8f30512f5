"""KUKA LBR iiwa 14 R820: seven joints, 14 kg. Figures from data sheet and brochure.

Upright it does not reach every trocar: its elbow bends by 120 degrees at most, and its wrist must
then be nowhere near the shoulder. It hangs from a column, tilted by two thirds of a half turn.
"""

from starjax.sim.arms.base import Arm, Mount, mounts

_MOUNT = Mount(
    position=(-0.444, 0.159, 1.15),
    yaw=-0.058,
    turn=2.516,
    home=(0.304, 1.329, 0.59, 1.778, -0.005, 1.326, -0.15),
    tilt=2.171,
)

_TISSUE = Mount(
    position=(-0.216, 0.101, 1.196),
    yaw=2.361,
    turn=-1.137,
    home=(-0.72, -1.197, 1.746, 1.795, -0.049, 1.197, -1.085),
    tilt=-2.083,
)

ARM = Arm(
    name="iiwa14",
    mjcf="arms/iiwa14/iiwa14.xml",
    first="link1",
    joints=("j1", "j2", "j3", "j4", "j5", "j6", "j7"),
    max_speed=(1.484, 1.484, 1.745, 1.309, 2.269, 2.356, 2.356),
    servo_frequency=100.0,
    mounts=mounts(_MOUNT, _TISSUE),
    rest_gain=0.1,
    link_radius=0.06,
)
