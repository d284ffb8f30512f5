"""The patient side manipulator of the da Vinci Si: the ranges and forces of a later generation."""

from starjax.sim.arms import psm

ARM = psm.ARM._replace(name="psm_si", mjcf="arms/psm/psm_si.xml")
