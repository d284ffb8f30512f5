"""Arms' MJCF files, validated for use in a scene."""

from collections.abc import Iterable

import mujoco

from starjax.core import errors
from starjax.sim import mjcf_parts
from starjax.sim.arms.base import Arm

FLANGE = "flange"  # the site that holds the tool


def read(arm: Arm) -> mujoco.MjSpec:
    """Reads the arm's MJCF part for attachment.

    Raises:
      errors.UsageError: it has no site `flange`, or a joint without a servo of its name or with
        friction loss.
    """
    part, count = f"arm {arm.name}", len(arm.joints)
    if len(arm.max_speed) != count:
        raise errors.UsageError(f"{part}: max_speed", f"{count} speeds", len(arm.max_speed))
    for (tool, place), mount in arm.mounts.items():
        if len(mount.home) != count:
            where = f"{part}: home with {tool} over the {place}"
            raise errors.UsageError(where, f"{count} joints", len(mount.home))
    spec = mjcf_parts.read(part, arm.mjcf)
    if spec.body(arm.first) is None:
        bodies = _joined(body.name for body in spec.bodies)
        raise errors.UsageError(f"{part}: first", f"a body of {arm.mjcf}", f"{arm.first}; {bodies}")
    sites = [site.name for site in spec.sites]
    if FLANGE not in sites:
        raise errors.UsageError(part, f"the site {FLANGE} at its end", _joined(sites), arm.mjcf)
    servos = {servo.name: servo.target for servo in spec.actuators}
    for joint in arm.joints:
        if servos.get(joint) != joint:
            raise errors.UsageError(
                part,
                f"a servo named {joint}",
                _joined(servos),
                arm.mjcf,
            )
    for joint in spec.joints:
        if joint.frictionloss:
            raise errors.UsageError(
                f"{part}: joint {joint.name}",
                "frictionloss 0, since the contact solver does not model it",
                f"{joint.frictionloss:g}",
            )
    return spec


def _joined(names: Iterable[str]) -> str:
    return ", ".join(names) or "none"
