"""Straight laparoscope: 10 mm shaft, a camera in its tip that looks along it."""

from starjax.sim.tools.base import Tool

TOOL = Tool(
    name="endoscope",
    mjcf="tools/endoscope/endoscope.xml",
    tcp="tcp",
    jaw=None,
    servo=None,
    closed=0.0,
    open=0.0,
    pads=(),
    is_symmetric=False,
    shaft_radius=0.005,
    shaft_end=0.001,
    pad_end=0.0,
    shaft_reach=0.06,
)
