"""Straight laparoscope whose camera looks 30 degrees aside, towards the picture's lower edge."""

from starjax.sim.tools import endoscope

TOOL = endoscope.TOOL._replace(name="endoscope30", mjcf="tools/endoscope30/endoscope30.xml")
