"""`starjax teleop`: records demonstrations by hand in the browser, as an ordinary dataset."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from starjax.addons.viewer.commands.view import Port
from starjax.cli import checks, options, policy_args
from starjax.core import config as config_lib
from starjax.core import errors
from starjax.core.limits import Range
from starjax.policies import packaged
from starjax.runtime import jax_start, signals, xla

DESCRIPTION = """Opens a page on which a person demonstrates a task.

The tool follows a handle in the 3D scene, the page's hotkeys, a SpaceMouse or a gamepad. Its shaft
always passes through the trocar, because these move only roll and tip, and the angles of a wrist.
Recording begins with the first motion. Enter saves an episode, Backspace discards it. Rerun the
same command to add episodes.

With --policy, the policy acts and T passes control to your hand and back. Saved are the episodes in
which your hand acted; starjax finetune --interventions learns the successful ones.

Examples:
  starjax teleop --task reach
  starjax teleop --task needle_pick --device spacemouse --out runs/hand
  starjax teleop --task peg_transfer --arm psm --tool needle_driver
  starjax teleop --policy compact --out runs/interventions"""


@dataclasses.dataclass(frozen=True)
class TeleopArgs:
    """Flags of the command."""

    # directory of the dataset; auto: runs/teleop-TASK or runs/interventions-POLICY
    out: str = options.AUTO
    # policy.safetensors or the name of a packaged policy that you relieve, in its own scene; its
    # task, robot and observation replace the flags
    policy: str = ""
    task: str = config_lib.DEFAULT_TASK  # task (see starjax list)
    arm: tuple[str, ...] = ()  # robots; default: the task's
    tool: tuple[str, ...] = ()  # instruments of the arms; default: the task's
    # recorded observation: pixels or the state of the task
    observation: Literal["image", "state"] = "image"
    image_size: Annotated[int, Range(32, 1_024)] = 128  # width and height of the images in pixels
    trocar: Annotated[int, Range(0, 999)] = 0  # index of the trocar configuration
    seed: config_lib.Seed = 0  # random seed of the initial states
    # additional input: a SpaceMouse (needs pyspacemouse) or a gamepad (needs pygame)
    device: Literal["none", "spacemouse", "gamepad"] = "none"
    port: Port = 8080  # port of the page, on this machine only; 0: a free one
    # further names of this machine in a browser's address, such as that of a proxy
    allow_host: tuple[str, ...] = ()


def main(argv: Sequence[str]) -> int:
    """Serves the page until a stop."""
    args = options.parse("teleop", TeleopArgs, argv, DESCRIPTION)
    file = packaged.find("--policy", args.policy) if args.policy else None
    default = f"teleop-{args.task}" if file is None else f"interventions-{policy_args.label(file)}"
    out = f"runs/{default}" if args.out == options.AUTO else args.out
    checks.expect_folder("--out", out)
    xla.prepare_xla()
    jax_start.require_devices("starjax.addons.viewer.teleop")

    from starjax.addons.viewer import devices, page, recorder, teleop

    env, policy = _scene(args, file)
    if args.trocar >= (count := len(env.task.is_seen)):
        raise errors.UsageError("--trocar", f"0 to {count - 1}", args.trocar)
    device = None if args.device == "none" else devices.open_device(args.device)
    try:
        with (
            signals.stop_signals() as should_stop,
            recorder.record_into(Path(out), env, args.seed, policy) as kept,
            page.serve(args.port, names=args.allow_host) as server,
        ):
            print(f"open {page.address(server)} in a browser; Ctrl-C closes it", flush=True)
            summary = teleop.run(
                server,
                recorder.steer(env, policy),
                kept,
                should_stop,
                device=device,
                trocar=args.trocar,
                seed=args.seed,
            )
    finally:
        if device:
            device.close()
    print(f"{summary}; dataset: {out}")
    return 0


def _scene(args: TeleopArgs, file: Path | None) -> tuple[Any, Any]:
    """Returns the environment, and the policy of a file as `recorder.Relieved`, or None."""
    from starjax.addons.viewer import shared_control
    from starjax.sim import env as sim_env

    if file is not None:
        return shared_control.relieved(file, args.arm)
    made = sim_env.make(
        args.task,
        args.arm,
        args.tool,
        observation=args.observation,
        image_size=args.image_size,
    )
    return made, None
