"""Reads an arm's MJCF, and refuses one that lacks what a scene needs of it."""

from collections.abc import Iterable

import mujoco

from starjax import errors
from starjax.sim import assets
from starjax.sim.arms.base import Arm

FLANGE = "flange"  # the site that holds the tool


def read(arm: Arm) -> mujoco.MjSpec:
    """The arm's part, to be attached.

    Raises:
      errors.UsageError: it has no site `flange`, or a joint without a servo of its name or with
        friction loss.
    """
    spec = mujoco.MjSpec.from_file(str(assets.path(arm.mjcf)))
    sites = [site.name for site in spec.sites]
    if FLANGE not in sites:
        raise errors.UsageError(
            f"arm {arm.name}", f"the site {FLANGE} at its end", _said(sites), arm.mjcf
        )
    servos = {servo.name: servo.target for servo in spec.actuators}
    for joint in arm.joints:
        if servos.get(joint) != joint:
            raise errors.UsageError(
                f"arm {arm.name}", f"a servo of joint {joint} by its name", _said(servos), arm.mjcf
            )
    for joint in spec.joints:
        if joint.frictionloss:
            raise errors.UsageError(
                f"arm {arm.name}: joint {joint.name}",
                "no frictionloss, which the contact solver does not know",
                f"{joint.frictionloss:g}",
            )
    return spec


def _said(names: Iterable[str]) -> str:
    return ", ".join(names) or "none"
