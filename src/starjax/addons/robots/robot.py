"""`starjax robot`: drives a robot on CRTK's topics by a policy."""

import dataclasses
import os
import sys
from collections.abc import Sequence
from typing import Annotated

import tyro

from starjax.cli import checks, options
from starjax.core.limits import Positive
from starjax.runtime import jax_start, signals, xla

DESCRIPTION = """Drives a surgical robot on CRTK's topics over DDS, as ROS 2 has them, by a policy.

Nothing is sent until all topics, frames and measurements agree; after a doubt a person begins
again. No ROS installation and no robot was tried.

Examples:
  starjax robot psm1.toml --check
  starjax robot psm1.toml --policy compact --dry-run
  starjax robot psm1.toml --server 10.0.0.2:8000 --seconds 30"""
_LOOK_S = 2.0  # s, to find topics and count messages


@dataclasses.dataclass(frozen=True)
class RobotArgs:
    """Flags of the command."""

    file: Annotated[
        str, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")
    ]  # TOML file of the robot
    policy: str = "compact"  # policy.safetensors, or the name of a packaged policy
    server: str = ""  # HOST:PORT of `starjax serve`, in place of a policy here
    check: bool = False  # print the topics and the doubts, and end
    dry_run: bool = False  # publish the plan only
    begin: bool = False  # begin without asking; the first doubt ends the run
    seconds: Positive = 60.0  # s of the run
    wait_s: Positive = 10.0  # s, for the robot's topics


def main(argv: Sequence[str]) -> int:
    """Checks, asks, runs; returns 1 after a doubt."""
    args = options.parse("robot", RobotArgs, argv, DESCRIPTION)
    from starjax.addons.robots import robot_file

    file = robot_file.read(args.file)
    is_asked = args.begin or args.check or args.dry_run or sys.stdin.isatty()
    checks.expect(is_asked, "--begin", "a terminal to ask at", "none")
    xla.prepare_xla()
    jax_start.require_devices("starjax.deploy.client")
    from starjax import deploy
    from starjax.addons.robots import arm as arms
    from starjax.addons.robots import bus, node, topic_table
    from starjax.deploy import in_process

    own = bus.Bus(file.network)
    options_ = {
        "clock": own.now,
        "limits": deploy.Limits(file.limits.speed, file.limits.turn_rate),
        "tolerances": node.tolerances(file, args.dry_run),
    }
    if args.server:
        key = os.environ.get(checks.API_KEY, "")
        client = deploy.Client(args.server, file.p_world_trocar, api_key=key, **options_)
    else:
        policy = deploy.load(args.policy)
        connect = {"connect": lambda *_: in_process.InProcess(policy)}
        client = deploy.Client("", file.p_world_trocar, **connect, **options_)
    with client, signals.stop_signals() as should_stop:
        spec = client.input_spec
        cameras = sorted(file.cameras) or "none"
        fits = set(file.cameras) == set(spec.cameras)
        checks.expect(fits, f"{args.file}: camera", f"tables {list(spec.cameras)}", cameras)
        arm = arms.CrtkArm(own, file, spec.image_size)
        rows = topic_table.look(arm, _LOOK_S, args.wait_s, should_stop)
        bad = topic_table.problems(rows) + [str(doubt) for doubt in node.doubts(arm, client)]
        print(topic_table.text(rows), *(f"- {line}" for line in bad), sep="\n", flush=True)
        if args.check or bad:
            return int(bool(bad))
        if not (args.begin or args.dry_run or _ask("all agree")):
            return 1
        arm.poll()
        report = node.run(
            arm,
            client,
            args.seconds,
            is_dry=args.dry_run,
            confirm=(lambda reason: False) if args.begin else _ask,
            should_stop=should_stop,
        )
    print(
        f"{report.steps} commands of {report.plans} plans, {report.held} held, {arm.sent} sent, "
        f"{report.overran} of them late"
    )
    if report.fault:
        print(report.fault)
    return int(bool(report.silent))


def _ask(reason: str) -> bool:
    """Asks a person who looks at the arm."""
    print(
        f"{reason}; Enter begins from the measured pose, anything else ends: ", end="", flush=True
    )
    return sys.stdin.isatty() and input() == ""
