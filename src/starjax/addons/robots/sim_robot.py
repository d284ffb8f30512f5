"""`starjax sim-robot`: a simulated manipulator on CRTK's topics, in place of a robot."""

import dataclasses
from collections.abc import Sequence
from typing import Annotated

from starjax.cli import checks, options
from starjax.core.limits import Positive, Range
from starjax.runtime import signals

DESCRIPTION = """Serves a patient side manipulator on CRTK's topics over DDS, as ROS 2 has them.

It is kinematic: it follows commands at bounded joint speeds and touches nothing. Its camera shows
a grey image.

Examples:
  starjax sim-robot
  starjax sim-robot --namespace /PSM2 --domain 7 --interface lo"""
ARMS = ("psm",)


@dataclasses.dataclass(frozen=True)
class SimRobotArgs:
    """Flags of the command."""

    arm: str = "psm"  # the simulated arm
    task: str = "needle_pick"  # whose camera gives the images their size
    namespace: str = "/PSM1"  # namespace of the arm's topics
    instrument: str = "large_needle_driver"  # or prograsp
    image_size: Annotated[int, Range(8, 1080)] = 128  # pixels per side
    domain: Annotated[int, Range(0, 232)] = 0  # ROS_DOMAIN_ID
    interface: str = "lo"  # network interface; empty: DDS's choice, with multicast
    seconds: Positive = 1e9  # s, until the end


def main(argv: Sequence[str]) -> int:
    """Serves until a stop."""
    args = options.parse("sim-robot", SimRobotArgs, argv, DESCRIPTION)
    import numpy as np

    from starjax.addons.robots import bus, robot_file, sim_arm
    from starjax.core import errors
    from starjax.sim import registries

    errors.choice("--arm", args.arm, ARMS)
    errors.choice("--task", args.task, registries.tasks.names())
    errors.choice("--instrument", args.instrument, robot_file.INSTRUMENTS)
    checks.expect(args.namespace.startswith("/"), "--namespace", "a name with a slash", "none")
    image = np.full((args.image_size, args.image_size, 3), 128, np.uint8)
    arm = sim_arm.SimArm(
        bus.Bus(robot_file.Network(args.domain, args.interface)),
        args.namespace,
        robot_file.INSTRUMENTS[args.instrument],
        image,
    )
    print(f"{args.namespace}: topics in domain {args.domain}; Ctrl-C ends it", flush=True)
    with signals.stop_signals() as should_stop:
        arm.run(args.seconds, should_stop)
    print(f"{arm.commands} commands, largest step {1e3 * arm.moved:.1f} mm", flush=True)
    return 0
