"""The stages of a run, one after another, each skipped when its result is there."""

import contextlib
import signal
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import starjax
from starjax import config as config_lib
from starjax.experiments import folders, methods
from starjax.runtime import files, xla

STAGES = ("collect", "train", "evaluate", "report")


def run(config: config_lib.RunConfig, stages: Sequence[str]) -> None:
    """Does what is missing of the given stages, in the order of `STAGES`."""
    xla.prepare_xla()
    out = Path(config.out)
    files.require_writable(out)
    names = folders.selected(config)
    with files.lock(out):
        _claim(config, names, stages)
        env = _environment(config)
        print(plan(config, stages), flush=True)
        demos = _collect(config, env)
        if "train" in stages:
            for name in dict.fromkeys(methods.METHODS[name].weights_of for name in names):
                _train(config, name, demos, env)


def plan(config: config_lib.RunConfig, stages: Sequence[str]) -> str:
    """What is going to happen, for the start of a run."""
    import jax

    demos, policy, train, evaluation = config.demos, config.policy, config.train, config.eval
    devices = jax.devices()
    channels = "-".join(map(str, policy.unet_channels))
    dtype = "" if policy.dtype == "float32" else f", {policy.dtype}"
    lines = [
        f"starjax {starjax.__version__}: method {config.method}, preset {config.preset}, "
        f"seed {config.seed}, folder {config.out}",
        f"device         {len(devices)} x {devices[0].device_kind}, {xla.cores()} CPU cores",
        f"observation    {observation(policy)}",
        f"demonstrations {demos.per_trocar * demos.seen_trocars} "
        f"({demos.per_trocar} x {demos.seen_trocars} seen trocars)",
    ]
    if "train" in stages:
        lines.append(
            f"training       {train.steps} steps of {train.batch_size}, U-Net {channels}{dtype}"
        )
    if "evaluate" in stages:
        lines.append(
            f"evaluation     12 trocars x {evaluation.trials} trials, "
            f"at most {evaluation.time_limit_s:g} s each"
        )
    return "\n".join(lines)


def observation(policy: config_lib.PolicyConfig) -> str:
    """What the policy sees, in words that stand at the start of a run and in its report."""
    if policy.observation == "state":
        return (
            "state (block pose and target position in the place of pixels; "
            "--policy.observation image turns the camera on)"
        )
    weights = policy.encoder_weights or "trained from scratch"
    return f"image, {policy.image_size} px ({policy.encoder}, {weights})"


def _claim(config: config_lib.RunConfig, names: Sequence[str], stages: Sequence[str]) -> None:
    """Every folder this run will write, refused at once if it belongs to other settings."""
    if "train" not in stages:
        return
    for name in dict.fromkeys(methods.METHODS[name].weights_of for name in names):
        folders.claim(Path(config.out) / name, config, folders.TRAINED_WITH)


def _environment(config: config_lib.RunConfig) -> Any:
    from starjax.sim import env

    return env.make(config.policy.observation, config.policy.image_size)


def _collect(config: config_lib.RunConfig, env: Any) -> Any:
    """The demonstrations, collected if they are not there, loaded."""
    import jax

    from starjax import rcm
    from starjax.data import demos, load, store
    from starjax.sim.tasks import expert

    trocars = jax.tree.map(lambda leaf: leaf[: config.demos.seen_trocars], rcm.TROCARS)
    wanted = {
        "per_trocar": config.demos.per_trocar,
        "seed": config.seed,
        "max_steps": config.demos.max_steps,
        "keep_failures": config.demos.keep_failures,
    }
    root = Path(config.out) / f"demos-{store.digest(demos.describe(env, trocars, **wanted))}"
    if not store.is_sealed(root):
        say("collect", f"into {root}")
        with folders.timed(Path(config.out), "collect"):
            demos.collect(root, env, expert, trocars, report=_indented, **wanted)
    else:
        say("collect", f"done before, {root}")
    return load.load(root, report=_indented)


def _train(config: config_lib.RunConfig, name: str, demos: Any, env: Any) -> None:
    """One set of weights; `policy.safetensors` is its last file."""
    from starjax.training import loop

    folder = Path(config.out) / name
    if (folder / "policy.safetensors").exists():
        say("train", f"{name}: done before, {folder}")
        return
    say("train", f"{name}, into {folder}")
    with folders.timed(Path(config.out), f"train {name}"), stop_signals() as should_stop:
        try:
            result = loop.run(
                methods.METHODS[name],
                config.policy,
                config.train,
                demos.dataset,
                env.p_world_ref,
                folder,
                config.seed,
                should_stop=should_stop,
                description=f"Training {name}",
            )
        except loop.TrainingFailed as error:
            raise config_lib.UsageError(str(error)) from error
    if result.samples_per_second:
        _indented(f"{result.samples_per_second:.0f} samples/s")


@contextlib.contextmanager
def stop_signals() -> Iterator[Callable[[], bool]]:
    """Yields `should_stop`: true after Ctrl-C or a termination signal; a second one ends at once."""
    asked = False

    def ask(number: int, frame: Any) -> None:
        nonlocal asked
        if asked:
            raise KeyboardInterrupt
        asked = True

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def say(stage: str, text: str) -> None:
    """One line that begins a stage."""
    print(f"\n[{STAGES.index(stage) + 1}/{len(STAGES)}] {stage}: {text}", flush=True)


def _indented(text: str) -> None:
    print(f"      {text}", flush=True)
