"""`starjax view`: a page in the browser with a policy, an expert or recorded episodes at work."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from starjax.cli import checks, folders, options
from starjax.core import config as config_lib
from starjax.core import errors
from starjax.core.limits import Range
from starjax.policies import packaged
from starjax.runtime import hub, jax_start, signals, xla

if TYPE_CHECKING:  # for annotations alone
    import viser

DESCRIPTION = """Shows a policy, an expert, a dataset or recorded trials on a page in the browser.

The page has the scene in 3D, the camera's image, the RCM error and the plan. Drag a trocar by its
arrows, or set it by sliders, and the policy continues through it, also in the next trials. Ctrl-C
closes the page.

With --record, T passes control from the policy to your hand and back, as in starjax teleop
--policy, and Enter saves the episode. Trials are then those of demonstrations, whose trocars stay.

Examples:
  starjax view
  starjax view --policy compact --compare-with expert --trocar 3
  starjax view --policy compact --record runs/interventions"""

Port = Annotated[int, Range(0, 65_535)]
Show = Callable[[Any, Callable[[], bool]], str]  # (server, should_stop) -> a last line


@dataclasses.dataclass(frozen=True)
class ViewArgs:
    """Flags of the command."""

    # policy.safetensors, or the name of a packaged policy
    policy: str = ""
    run: str = ""  # directory of a method, such as runs/cpu/stardiff: its policy
    expert: bool = False  # the task's scripted demonstrator, the default
    dataset: str = ""  # directory of demonstrations: its episodes
    # pixels per side of images that are drawn for --dataset
    image_size: Annotated[int, Range(1, 4_096)] = 256
    # recorded.npz or invalid.npz of an evaluation: its trials
    trials: str = ""
    # second agent at the same trial: expert, or a policy as above
    compare_with: str = ""
    # directory of the episodes in which your hand relieved --policy or --run
    record: str = ""
    # sweep.json of starjax sweep, whose trials are dots above a map; default: the one in --run
    sweep: str = ""
    task: str = config_lib.DEFAULT_TASK  # task of the expert
    arm: str = ""  # robot instead of those of the training
    trocar: Annotated[int, Range(0, 999)] = 8  # index of the trocar configuration
    trial: Annotated[int, Range(0, 999_999)] = 0  # number of the first trial
    seed: config_lib.Seed = 0  # random seed of the trials
    port: Port = 8080  # port of the page, on this machine only; 0: a free one
    # further names of this machine in a browser's address, such as that of a proxy
    allow_host: tuple[str, ...] = ()


def main(argv: Sequence[str]) -> int:
    """Serves the page until a stop."""
    args = options.parse("view", ViewArgs, argv, DESCRIPTION)
    named = [name for name in ("policy", "run", "dataset", "trials") if getattr(args, name)]
    named += ["expert"] if args.expert else []
    if len(named) > 1:
        got = " and ".join(f"--{name}" for name in named)
        raise errors.UsageError(
            "--policy, --run, --expert, --dataset or --trials", "at most one of them", got
        )
    if args.record:
        _expect_recordable(args)
    xla.prepare_xla()
    jax_start.require_devices("starjax.addons.viewer.view")

    from starjax.addons.viewer import page

    if args.trials:
        show = _trials(args.trials)
    elif args.record:
        show = _recorded(args)
    else:
        show = _dataset(args.dataset, args.image_size) if args.dataset else _live(args)
    served = page.serve(args.port, names=args.allow_host)
    with signals.stop_signals() as should_stop, served as server:
        print(f"open {page.address(server)} in a browser; Ctrl-C closes it", flush=True)
        print(show(server, should_stop))
    return 0


def _expect_recordable(args: ViewArgs) -> None:
    """Refuses --record without a policy of its own on the page."""
    if not (args.policy or args.run):
        raise errors.UsageError("--record", "--policy or --run", "neither")
    for flag in ("compare_with", "sweep"):
        if value := getattr(args, flag):
            name = f"--{flag.replace('_', '-')}"
            raise errors.UsageError(name, "none with --record", value)
    checks.expect_folder("--record", args.record)


def _recorded(args: ViewArgs) -> Show:
    """Returns the view of a policy whose operator is recorded."""
    from starjax.addons.viewer import recorder, relief, shared_control

    agent = _agent(args.policy, args.run, args.task)
    _expect_scene(args, agent.task)
    env, policy = shared_control.relieved(agent.file, (args.arm,) if args.arm else ())

    def show(server: "viser.ViserServer", should_stop: Callable[[], bool]) -> str:
        with recorder.record_into(Path(args.record), env, args.seed, policy) as kept:
            steering = recorder.steer(env, policy)
            summary = relief.run(
                server,
                agent.label,
                steering,
                kept,
                should_stop,
                trocar=args.trocar,
                seed=args.seed,
            )
        return f"{summary}; dataset: {args.record}"

    return show


def _expect_scene(args: ViewArgs, task: str) -> None:
    """Checks --arm and --trocar."""
    from starjax.sim import registries

    if args.arm:
        errors.choice("--arm", args.arm, registries.arms.names())
    count = len(registries.tasks.get(task).is_seen)
    if args.trocar >= count:
        raise errors.UsageError("--trocar", f"0 to {count - 1}", args.trocar)


def _dataset(folder: str, image_size: int) -> Show:
    """Returns the viewer of recorded episodes."""
    from starjax.addons.viewer import browse

    try:
        dataset = browse.open_dataset(hub.dataset("--dataset", folder), image_size)
    except ValueError as error:  # from a damaged file, which it names
        raise errors.UsageError("--dataset", "a folder of demonstrations", error) from error
    episodes = browse.of_dataset(dataset)
    return lambda server, should_stop: browse.run(server, episodes, should_stop)


def _trials(file: str) -> Show:
    """Returns the viewer of an evaluation's recorded trials."""
    from starjax.addons.viewer import browse, trials

    try:
        recordings = trials.load(Path(file))
    except (FileNotFoundError, ValueError) as error:  # it names the file
        if isinstance(error, errors.UsageError):
            raise
        raise errors.UsageError("--trials", "trials of an evaluation", error) from error
    return lambda server, should_stop: browse.run(server, recordings, should_stop)


def _live(args: ViewArgs) -> Show:
    """Makes the live view of one agent or two."""
    from starjax.addons.viewer import selection, simulation, view

    agents = [_agent(args.policy, args.run, args.task)]
    if args.compare_with:
        name = "" if args.compare_with == simulation.EXPERT else args.compare_with
        agents.append(_agent(name, "", agents[0].task))
    if agents[-1].task != agents[0].task:
        raise errors.UsageError(
            "--compare-with", f"one that does {agents[0].task}", agents[-1].task
        )
    _expect_scene(args, agents[0].task)
    initial = selection.ViewOptions(
        tuple(agents),
        args.arm or selection.OWN_ARMS,
        args.trocar,
        args.seed,
        _sweep(args, agents[0].task),
        args.trial,
    )
    return lambda server, should_stop: view.run(server, initial, should_stop)


def _sweep(args: ViewArgs, task: str) -> Any:
    """Returns the trials of --sweep, or of the sweep in --run, if any."""
    from starjax.addons.viewer import success_map

    file = Path(args.sweep) if args.sweep else Path(args.run or ".") / "sweep.json"
    if not args.sweep and not (args.run and file.is_file()):
        return None
    try:
        sweep = success_map.read(file)
    except (OSError, ValueError) as error:
        raise errors.UsageError("--sweep", "a sweep.json", error) from error
    if sweep.task != task:
        raise errors.UsageError("--sweep", f"a sweep of {task}", sweep.task)
    return sweep


def _agent(policy: str, run: str, task: str) -> Any:
    from starjax.addons.viewer import simulation

    if run:
        folder = folders.existing(run)
        file = folders.weights(folder.parent, folder.name)
        if not file.is_file():
            raise errors.UsageError(str(file), "trained weights", "none")
        return simulation.from_file(file, f"{folder.parent.name}/{folder.name}")
    if policy:
        return simulation.from_file(packaged.find("--policy", policy), Path(policy).stem)
    return simulation.expert(task)
