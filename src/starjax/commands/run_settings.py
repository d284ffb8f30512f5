"""Settings of a run from its command line."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from starjax import config as config_lib
from starjax import errors
from starjax.commands import checks, options, presets
from starjax.learners import LEARNERS
from starjax.runtime import gpu


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Learning:
    learner: str = ""


@dataclasses.dataclass(frozen=True, kw_only=True)
class _First:
    """Flags that other flags and their defaults depend on."""

    preset: config_lib.Preset = "auto"
    policy: _Learning = _Learning()


def parse(argv: Sequence[str], prog: str, description: str) -> config_lib.RunConfig:
    """Settings of a run from its command line: the preset's values under what was typed.

    Preset `auto` is a guess until jax has started, which is after the first mistake is found.
    """
    guess = gpu.is_likely()
    config = _settings(argv, prog, description, guess)
    if options.peek(_First, argv, _First()).preset != "auto":
        return config
    from starjax.commands import pipeline

    pipeline.start()
    from starjax.runtime import processes

    is_used = gpu.is_used()
    config = config if is_used == guess else _settings(argv, prog, description, is_used)
    if processes.is_first():
        print(f"preset auto: {config.preset}, as {presets.reason(is_used)}", flush=True)
    return config


def _settings(
    argv: Sequence[str], prog: str, description: str, has_gpu: bool
) -> config_lib.RunConfig:
    default = _default(argv, has_gpu)
    config = options.parse(
        config_lib.RunConfig, argv, prog=prog, description=description, default=default
    )
    config = dataclasses.replace(config, preset=default.preset)
    out = config.out if config.out != options.AUTO else _folder(config)
    config = dataclasses.replace(config, out=out)
    checks.check(config)
    checks.expect_folder("--out", out)
    return config


def _default(argv: Sequence[str], has_gpu: bool) -> config_lib.RunConfig:
    """Values of what is not typed: the preset's, without what does not go with what is typed."""
    first = options.peek(_First, argv, _First())
    default = presets.resolve(first.preset, has_gpu)
    if first.policy.learner:
        errors.choice("policy.learner", first.policy.learner, LEARNERS.names())
        learning = config_lib.with_learner(default.policy, first.policy.learner)
        default = dataclasses.replace(default, policy=learning)
    asked = options.peek(config_lib.RunConfig, argv, default)
    policy, demos = default.policy, default.demos
    if asked.policy.observation == "state":
        policy = dataclasses.replace(policy, encoder_weights="", freeze_encoder=False)
    if asked.scene.task != default.scene.task:
        demos = dataclasses.replace(demos, expert="")
    return dataclasses.replace(default, policy=policy, demos=demos)


def _folder(config: config_lib.RunConfig) -> str:
    """Folder of a run that names none.

    Other scenes, datasets, learners, observations, encoders frozen or not, and seeds have one each;
    trainings of one method that differ in anything else meet in it, and are refused.
    """
    policy, usual = config.policy, presets.PRESETS[config.preset]
    scene = config.scene
    parts = [usual.preset]
    parts += [scene.task] if scene.task != usual.scene.task else []
    parts += [*scene.arm, *scene.tool, *(name for name in scene.camera if name != "fixed")]
    parts += [f"from-{Path(config.demos.from_).name}"] if config.demos.from_ else []
    parts += [policy.learner] if policy.learner != usual.policy.learner else []
    parts += [policy.observation] if policy.observation != usual.policy.observation else []
    sees, freezes = policy.observation == "image", policy.freeze_encoder
    if sees and freezes != usual.policy.freeze_encoder:
        parts.append("frozen" if freezes else "unfrozen")
    parts += [f"seed{config.seed}"] if config.seed != usual.seed else []
    return f"runs/{'-'.join(parts)}"
