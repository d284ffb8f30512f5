"""The dVRK's patient side manipulator: a mechanical remote centre, its joints named as in CRTK.

With the tool `needle_driver` it is the robot of the Denavit-Hartenberg parameters in its public
description (a test). `addons.robots.psm` has its closed forms, `addons.robots.crtk` its messages.
"""

import math

from starjax.sim.arms.base import Arm, Mount, opposite

_BOARD = Mount(position=(0.0, 0.0, 0.0), yaw=-0.2, turn=0.0, home=(0.0, 0.0, 0.11, 0.0))

ARM = Arm(
    name="psm",
    mjcf="arms/psm/psm.xml",
    first="yaw",
    joints=("outer_yaw", "outer_pitch", "outer_insertion", "outer_roll"),
    # Limits of the dVRK's own trajectories (mtsIntuitiveResearchKitPSM).
    max_speed=(math.pi, math.pi, 0.2, 6.0 * math.pi),
    servo_frequency=100.0,
    mounts={
        ("grasper", "board"): _BOARD,
        ("needle_driver", "board"): _BOARD,
        ("prograsp", "board"): _BOARD,
        ("needle_driver", "left"): _BOARD,
        ("needle_driver", "right"): opposite(_BOARD),
    },
    link_radius=0.02,
    remote_centre=True,
)
