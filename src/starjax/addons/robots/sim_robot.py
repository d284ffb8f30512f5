"""`starjax sim-robot`: a simulated manipulator on CRTK's topics, in place of a robot."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from starjax.cli import checks, options
from starjax.core.limits import Positive, Range
from starjax.runtime import jax_start, signals, xla

if TYPE_CHECKING:  # for annotations alone
    from starjax.addons.robots.scene_body import SceneBody
    from starjax.addons.robots.sim_arm import Kinematic

DESCRIPTION = """Serves a simulated arm on CRTK's topics over DDS, as ROS 2 has them.

It is a scene of a task with contact, stepped by its own clock, which it publishes. Without a task
it is a kinematic manipulator that touches nothing, and its camera shows a grey image.

Examples:
  starjax sim-robot
  starjax sim-robot --task needle_pick --file sim.toml
  starjax sim-robot --arm fr5 --instrument grasper --task peg_transfer --file sim.toml"""


@dataclasses.dataclass(frozen=True)
class SimRobotArgs:
    """Flags of the command."""

    arm: str = "psm"  # the simulated arm: psm, or another of `starjax list`
    task: str = ""  # scene with contact; empty: a kinematic arm without one
    namespace: str = "/PSM1"  # namespace of the arm's topics
    instrument: str = "large_needle_driver"  # or prograsp; of other arms a straight tool
    camera: tuple[str, ...] = ()  # cameras of the task; none for its first one
    image_size: Annotated[int, Range(16, 1080)] = 128  # pixels per side
    trocar: Annotated[int, Range(0, 10**6)] = 0  # index of the task's trocars
    seed: Annotated[int, Range(0, 10**6)] = 0  # random seed, places the objects
    file: str = ""  # write the file for `starjax robot` here
    domain: Annotated[int, Range(0, 232)] = 0  # ROS_DOMAIN_ID
    interface: str = "lo"  # network interface; empty: DDS's choice, with multicast
    seconds: Positive = 1e9  # s of its own clock, until the end


def main(argv: Sequence[str]) -> int:
    """Serves until a stop."""
    args = options.parse("sim-robot", SimRobotArgs, argv, DESCRIPTION)
    import numpy as np

    from starjax.addons.robots import kinematics
    from starjax.core import errors
    from starjax.sim import registries

    is_psm = args.arm == kinematics.PSM
    known = list(kinematics.INSTRUMENTS) if is_psm else registries.tools.names()
    errors.choice("--arm", args.arm, kinematics.kinds())
    errors.choice("--instrument", args.instrument, known)
    checks.expect(args.namespace.startswith("/"), "--namespace", "a name with a slash", "none")
    checks.expect(bool(args.task) or not args.file, "--file", "a --task", "none")
    if args.task:
        errors.choice("--task", args.task, registries.tasks.names())
    xla.prepare_xla()
    jax_start.require_devices("starjax.sim.env")
    from starjax.addons.robots import bus, robot_file, scene_body, sim_arm

    network = robot_file.Network(args.domain, args.interface, use_sim_time=bool(args.task))
    if args.task:
        body = scene_body.SceneBody(
            args.task,
            args.arm,
            args.instrument,
            cameras=args.camera,
            image_size=args.image_size,
            trocar=args.trocar,
            seed=args.seed,
        )
    else:
        grey = np.full((args.image_size, args.image_size, 3), 128, np.uint8)
        kind = kinematics.of(args.arm, args.instrument, "peg_transfer")
        body = sim_arm.Kinematic(kind, grey)
    own = bus.Bus(dataclasses.replace(network, use_sim_time=False))
    arm = sim_arm.SimArm(own, body, args.namespace, is_clocked=bool(args.task))
    if args.task and args.file:
        Path(args.file).write_text(robot_file.text(_file_of(args, body, network)))
    print(f"{args.namespace}: topics in domain {args.domain}; Ctrl-C ends it", flush=True)
    with signals.stop_signals() as should_stop:
        arm.run(args.seconds, should_stop)
    print(f"{arm.commands} commands, largest step {1e3 * arm.moved:.1f} mm", flush=True)
    if args.task:
        print(f"{args.task}: {'success' if body.is_success else 'no success'}", flush=True)
    return 0


def _file_of(args: SimRobotArgs, body: "SceneBody | Kinematic", network: Any) -> Any:
    """Returns the file of `starjax robot` for a scene: its base, trocar and cameras, full speed."""
    from scipy.spatial.transform import Rotation

    from starjax.addons.robots import crtk, robot_file, sim_arm
    from starjax.deploy import Limits
    from starjax.sim import control

    base = body.pose_world_base
    place = crtk.compose(base, crtk.pose_of_arrays(base.R, body.p_base_trocar))
    return robot_file.RobotFile(
        robot_file.ArmTable(
            args.namespace,
            args.arm,
            frame=sim_arm.frame_of(args.namespace),
            instrument=args.instrument,
            task=args.task,
            closed=sim_arm.JAW.closed,
            open=sim_arm.JAW.open,
            position=tuple(map(float, base.p)),
            quaternion_xyzw=tuple(map(float, Rotation.from_matrix(base.R).as_quat())),
        ),
        robot_file.TrocarTable(tuple(map(float, place.p)), "/trocar"),
        {name: robot_file.CameraTable(f"/{name}/image_raw") for name in body.env.names.cameras},
        robot_file.LimitsTable(
            speed=Limits().speed,
            turn_rate=Limits().turn_rate,
            following_m=control.MAX_SPEED * sim_arm.WATCHDOG_S,
        ),
        network,
    )
