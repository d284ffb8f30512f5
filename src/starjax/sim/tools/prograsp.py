"""ProGrasp forceps of the dVRK: as its large needle driver, with a longer clevis and wider pads."""

from starjax import rcm
from starjax.sim.tools import needle_driver

TOOL = needle_driver.TOOL._replace(
    name="prograsp", mjcf="tools/prograsp/prograsp.xml", wrist=rcm.PROGRASP
)
