"""Franka Emika Panda: seven joints, 3 kg. Figures from the maker's documentation."""

from starjax.sim.arms.base import Arm, Mount, mounts

_LEFT = Mount(
    position=(-0.422, -0.006, -0.399),
    yaw=0.289,
    turn=-1.056,
    home=(-0.276, -0.869, 0.005, -2.188, -0.003, 1.752, 1.073),
)

_WIRE = Mount(
    position=(-0.376, 0.002, -0.274),
    yaw=0.631,
    turn=0.145,
    home=(-0.654, -0.539, 0.013, -2.062, 0.006, 1.523, -0.156),
)
_TISSUE = Mount(
    position=(-0.312, 0.191, -0.291),
    yaw=0.432,
    turn=-1.199,
    home=(-0.812, -0.446, -0.089, -1.841, -0.08, 1.319, 0.723),
)

_BOARD = Mount(
    position=(-0.363, -0.085, -0.333),
    yaw=-0.277,
    turn=-0.221,
    home=(0.499, -0.513, 0.005, -1.939, 0.002, 1.426, 0.448),
)

ARM = Arm(
    name="panda",
    mjcf="arms/panda/panda.xml",
    first="link1",
    joints=("j1", "j2", "j3", "j4", "j5", "j6", "j7"),
    max_speed=(2.175,) * 4 + (2.61,) * 3,
    servo_frequency=100.0,
    mounts=mounts(_BOARD, _TISSUE, wire=_WIRE, left=_LEFT),
    rest_gain=0.1,
    link_radius=0.055,
    watched=4,  # its base and elbow are below the table top, next to the table
)
