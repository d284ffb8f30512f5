"""Large needle driver of the dVRK: 8 mm shaft, a wrist, two jaws that turn."""

import math

from starjax import rcm
from starjax.sim.tools.base import Tool

TOOL = Tool(
    name="needle_driver",
    mjcf="tools/needle_driver/needle_driver.xml",
    tcp="tcp",
    jaw="jaw_left",
    servo="gripper",
    closed=-0.12,
    open=0.3,  # 34 degrees between the jaws
    pads=("pad_left", "pad_right"),
    is_symmetric=True,
    shaft_radius=0.004,
    shaft_end=0.004,
    pad_end=0.0019,
    shaft_reach=0.036,
    wrist=rcm.LARGE_NEEDLE_DRIVER,
    shaft="shaft",
    wrist_joints=("pitch", "yaw"),
    wrist_speed=6.0 * math.pi,  # limit of the dVRK's own trajectories (mtsIntuitiveResearchKitPSM)
    palm_radius=0.0035,
)
