"""Settings of a run from its command line."""

import dataclasses
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

from starjax.cli import benchmark_args, checks, options, presets, session
from starjax.core import config as config_lib
from starjax.core import errors, extras
from starjax.core.learners import LEARNERS

NO_TRACKER = "none"
_METHOD = "--method"


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunArgs(benchmark_args.BenchmarkArgs, config_lib.RunConfig):
    """Flags of the command: the settings of a run, and those that no result depends on."""

    # copy the training log to a tracker; needs the extra of the same name
    track: Literal["none", "tensorboard", "wandb"] = NO_TRACKER


def parse(name: str, argv: Sequence[str], description: str) -> config_lib.RunConfig:
    """Returns the settings of a run: the typed flags over the values of the preset.

    Only preset `auto` starts jax, as it depends on the device.
    """
    argv = _joined(argv)
    preset = options.typed_value("preset", argv) or "auto"
    if preset != "auto":
        return _settings(name, argv, description, preset)
    config = session.for_device(
        lambda is_gpu: _settings(name, argv, description, "gpu" if is_gpu else "cpu"),
        *session.RUN_MODULES,
    )
    from starjax.runtime import processes

    if processes.is_first():
        reason = presets.reason(config.preset == "gpu")
        print(f"preset auto: {config.preset}, because {reason}", flush=True)
    return config


def _joined(argv: Sequence[str]) -> Sequence[str]:
    """Returns the words with those that follow --method as one, separated by commas."""
    if argv is options.DECLARE or _METHOD not in argv:
        return argv
    first = argv.index(_METHOD) + 1
    names = list(itertools.takewhile(lambda word: not word.startswith("-"), argv[first:]))
    rest = argv[first + len(names) :]
    return [*argv[:first], *[",".join(names)] * bool(names), *rest]


def tracker(argv: Sequence[str]) -> str:
    """Returns the tracker that a command line, which `parse` has accepted, names."""
    return options.typed_value("track", argv) or NO_TRACKER


def _settings(
    name: str, argv: Sequence[str], description: str, preset: str
) -> config_lib.RunConfig:
    default = _default(argv, preset)
    args = options.parse(name, RunArgs, argv, description, RunArgs(**vars(default)))
    benchmark_args.check(args, default)
    args = benchmark_args.with_trials(args, "evaluate", args.scene.task)
    if args.track != NO_TRACKER:
        extras.require(f"--track {args.track}", args.track)
    settings: dict[str, Any] = {
        field.name: getattr(args, field.name) for field in dataclasses.fields(default)
    }
    config = dataclasses.replace(config_lib.RunConfig(**settings), preset=default.preset)
    out = config.out if config.out != options.AUTO else _folder(config)
    config = dataclasses.replace(config, out=out)
    checks.check(config)
    checks.expect_folder("--out", out)
    return config


def _default(argv: Sequence[str], preset: str) -> config_lib.RunConfig:
    """Returns the values of a preset, without those that the typed flags rule out."""
    errors.choice("--preset", preset, ["auto", *presets.PRESETS])
    default = presets.PRESETS[preset]
    policy, demos = default.policy, default.demos
    if learner := options.typed_value("policy.learner", argv):
        errors.choice("policy.learner", learner, LEARNERS.names())
        policy = config_lib.with_learner(policy, learner)
    if options.typed_value("policy.observation", argv) == "state":
        policy = dataclasses.replace(policy, encoder_weights="", freeze_encoder=False)
    task = options.typed_value("scene.task", argv)
    if task not in (None, default.scene.task):
        demos = dataclasses.replace(demos, expert="")
    if task in presets.EXECUTE:
        policy = dataclasses.replace(policy, execute=presets.EXECUTE[task])
    return dataclasses.replace(default, policy=policy, demos=demos)


def _folder(config: config_lib.RunConfig) -> str:
    """Returns the directory of a run without --out.

    Other scenes, datasets, learners, observations, frozen or trained encoders, and seeds have their
    own. Runs of one method that differ otherwise share it, and the second one is refused.
    """
    policy, preset = config.policy, presets.PRESETS[config.preset]
    scene = config.scene
    parts = [preset.preset]
    parts += [scene.task] if scene.task != preset.scene.task else []
    parts += [*scene.arm, *scene.tool, *(name for name in scene.camera if name != "fixed")]
    parts += [f"from-{Path(config.demos.from_).name}"] if config.demos.from_ else []
    parts += [policy.learner] if policy.learner != preset.policy.learner else []
    parts += [policy.observation] if policy.observation != preset.policy.observation else []
    if policy.observation == "image" and policy.freeze_encoder != preset.policy.freeze_encoder:
        parts.append("frozen" if policy.freeze_encoder else "unfrozen")
    parts += [f"seed{config.seed}"] if config.seed != preset.seed else []
    return f"runs/{'-'.join(parts)}"
