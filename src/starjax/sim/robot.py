"""Arms' MJCF files, validated for use in a scene."""

from collections.abc import Iterable

import mujoco

from starjax import errors
from starjax.sim import assets
from starjax.sim.arms.base import Arm

FLANGE = "flange"  # the site that holds the tool


def read(arm: Arm) -> mujoco.MjSpec:
    """Reads the arm's MJCF part for attachment.

    Raises:
      errors.UsageError: it has no site `flange`, or a joint without a servo of its name or with
        friction loss.
    """
    spec = mujoco.MjSpec.from_file(str(assets.path(arm.mjcf)))
    sites = [site.name for site in spec.sites]
    if FLANGE not in sites:
        raise errors.UsageError(
            f"arm {arm.name}", f"the site {FLANGE} at its end", _joined(sites), arm.mjcf
        )
    servos = {servo.name: servo.target for servo in spec.actuators}
    for joint in arm.joints:
        if servos.get(joint) != joint:
            raise errors.UsageError(
                f"arm {arm.name}",
                f"a servo named {joint}",
                _joined(servos),
                arm.mjcf,
            )
    for joint in spec.joints:
        if joint.frictionloss:
            raise errors.UsageError(
                f"arm {arm.name}: joint {joint.name}",
                "frictionloss 0, since the contact solver does not model it",
                f"{joint.frictionloss:g}",
            )
    return spec


def _joined(names: Iterable[str]) -> str:
    return ", ".join(names) or "none"
