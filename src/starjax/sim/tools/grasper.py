"""Straight laparoscopic grasper: 5 mm shaft, two parallel jaws."""

from starjax.sim.tools.base import Tool

TOOL = Tool(
    name="grasper",
    mjcf="tools/grasper/grasper.xml",
    tcp="tcp",
    jaw="jaw_left",
    servo="gripper",
    closed=-0.001,
    open=0.0032,
    pads=("pad_left", "pad_right"),
    is_symmetric=True,
    shaft_radius=0.0025,
    shaft_end=0.012,
    pad_end=0.0025,
    shaft_reach=0.036,
)
