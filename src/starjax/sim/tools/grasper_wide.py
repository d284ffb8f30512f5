"""The straight grasper, its jaws opening further, to straddle flat things while it leans."""

from starjax.sim.tools import grasper

TOOL = grasper.TOOL._replace(name="grasper_wide", open=0.0045)
