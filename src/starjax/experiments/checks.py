"""Ranges of a run's settings, and its folder, checked before anything heavy is imported."""

import dataclasses
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from starjax import config as config_lib
from starjax import methods
from starjax.experiments import options

SEEDS = 2**32  # a key of jax takes 32 bits: larger seeds would be those of others again
LEAST_TIME_S, MOST_TIME_S = 0.1, 86_400.0  # of a trial; one control step takes 1/30 s
MOST_TRIALS = 1_000_000
MOST_COUNT = 2**31 - 1  # whole numbers of compiled programs have 32 bits
# More is a slip of the hand, and would be traced for hours or fill the memory.
_MOST = {
    "policy.image-size": 4_096,  # pixels
    "policy.horizon": 4_096,
    "policy.vision-dim": 65_536,
    "policy.state-dim": 65_536,
    "policy.unet-channels": 65_536,
    "policy.kernel-size": 4_095,
    "policy.time-dim": 65_536,
    "policy.roll-width": 65_536,
    "policy.roll-blocks": 1_000,
    "policy.diffusion-steps": 1_000_000,
}
_CELL = {"resnet18": 32, "small": 8}  # pixels that a vision encoder makes one of its maps' cells


def check(config: config_lib.RunConfig) -> None:
    """Raises UsageError for the first value that is out of its range."""
    options.choice("--method", config.method, [*methods.METHODS, "all"])
    expect_finite(config)
    demos, policy, train, evaluation = config.demos, config.policy, config.train, config.eval
    positive = {
        "demos.per-trocar": demos.per_trocar,
        "demos.max-steps": demos.max_steps,
        "policy.obs-horizon": policy.obs_horizon,
        "policy.execute": policy.execute,
        "policy.groups": policy.groups,
        "policy.roll-width": policy.roll_width,
        "train.steps": train.steps,
        "train.batch-size": train.batch_size,
        "train.learning-rate": train.learning_rate,
        "train.steps-per-call": train.steps_per_call,
        "train.checkpoint-every": train.checkpoint_every,
        "train.keep-checkpoints": train.keep_checkpoints,
        "train.log-every": train.log_every,
    }
    for name, value in positive.items():
        expect(value > 0, name, "more than 0", value)
    not_negative = {
        "policy.roll-blocks": policy.roll_blocks,
        "policy.roll-loss-weight": policy.roll_loss_weight,
        "train.weight-decay": train.weight_decay,
        "train.roll-weight-decay": train.roll_weight_decay,
        "train.warmup-steps": train.warmup_steps,
        "train.jitter": train.jitter,
        "train.image-noise": train.image_noise,
        "train.state-noise": train.state_noise,
        "train.holdout-demos": train.holdout_demos,
        "eval.chunk": evaluation.chunk,
        "eval.video-trials": evaluation.video_trials,
    }
    for name, value in not_negative.items():
        expect(value >= 0, name, "0 or more", value)
    expect(0 <= config.seed < SEEDS, "seed", f"0 to {SEEDS - 1}", config.seed)
    seen, fraction = demos.seen_trocars, policy.crop_fraction
    expect(1 <= seen <= 8, "demos.seen-trocars", "1 to 8", seen)
    expect(0 < fraction <= 1, "policy.crop-fraction", "in (0, 1]", fraction)
    expect(0 <= train.ema_max < 1, "train.ema-max", "in [0, 1)", train.ema_max)
    _check_sizes(config)
    _check_networks(policy)
    _check_sampling(policy)
    _check_encoder(policy)
    trials, seconds = evaluation.trials, evaluation.time_limit_s
    limits = f"{LEAST_TIME_S:g} to {MOST_TIME_S:g} s"
    expect(1 <= trials <= MOST_TRIALS, "eval.trials", f"1 to {MOST_TRIALS}", trials)
    expect(LEAST_TIME_S <= seconds <= MOST_TIME_S, "eval.time-limit-s", limits, seconds)


def _check_sizes(config: config_lib.RunConfig) -> None:
    for part in ("demos", "policy", "train", "eval"):
        for field, value in vars(getattr(config, part)).items():
            name = f"{part}.{field.replace('_', '-')}"
            most = _MOST.get(name, MOST_COUNT)
            for number in value if isinstance(value, tuple) else (value,):
                fits = not isinstance(number, int) or number <= most
                expect(fits, name, f"at most {most}", number)


def _check_networks(policy: config_lib.PolicyConfig) -> None:
    levels, kernel, width = len(policy.unet_channels), policy.kernel_size, policy.time_dim
    expect(policy.vision_dim >= 2, "policy.vision-dim", "2 or more", policy.vision_dim)
    expect(policy.state_dim >= 4, "policy.state-dim", "4 or more", policy.state_dim)
    expect(kernel > 0 and kernel % 2 == 1, "policy.kernel-size", "an odd number above 0", kernel)
    expect(width >= 4 and width % 2 == 0, "policy.time-dim", "an even number, 4 or more", width)
    expect(levels >= 1, "policy.unet-channels", "at least one level", policy.unet_channels)
    expect(
        all(channels > 0 and channels % policy.groups == 0 for channels in policy.unet_channels),
        "policy.unet-channels",
        f"multiples of policy.groups = {policy.groups}",
        policy.unet_channels,
    )
    expect(
        policy.horizon > 0 and policy.horizon % 2 ** (levels - 1) == 0,
        "policy.horizon",
        f"a multiple of {2 ** (levels - 1)} for {levels} U-Net levels",
        policy.horizon,
    )


def _check_sampling(policy: config_lib.PolicyConfig) -> None:
    executed = f"at most policy.horizon = {policy.horizon}"
    fewest, diffusion = config_lib.FEWEST_DDIM_STEPS, policy.diffusion_steps
    expect(diffusion >= fewest, "policy.diffusion-steps", f"{fewest} or more", diffusion)
    steps = f"{fewest} to policy.diffusion-steps = {policy.diffusion_steps}"
    expect(policy.execute <= policy.horizon, "policy.execute", executed, policy.execute)
    observed = f"at most policy.execute + 1 = {policy.execute + 1}"
    expect(
        policy.obs_horizon <= policy.execute + 1, "policy.obs-horizon", observed, policy.obs_horizon
    )
    expect(
        fewest <= policy.ddim_steps <= policy.diffusion_steps,
        "policy.ddim-steps",
        steps,
        policy.ddim_steps,
    )
    expect(0 <= policy.temperature <= 1, "policy.temperature", "in [0, 1]", policy.temperature)


def _check_encoder(policy: config_lib.PolicyConfig) -> None:
    expect(policy.image_size >= 32, "policy.image-size", "32 pixels or more", policy.image_size)
    if policy.observation == "image":
        cell, crop = _CELL[policy.encoder], round(policy.image_size * policy.crop_fraction)
        expect(
            crop > cell,
            "policy.image-size",
            f"more than {cell} pixels left by policy.crop-fraction = {policy.crop_fraction:g}",
            crop,
        )
    if policy.freeze_encoder:
        expect(
            policy.observation == "image",
            "policy.freeze-encoder",
            "--policy.observation image",
            policy.observation,
        )
        expect(
            bool(policy.encoder_weights),
            "policy.freeze-encoder",
            "--policy.encoder-weights with a trained policy",
            "none",
        )


def expect_named(out: str, argv: Sequence[str]) -> None:
    """Raises UsageError where `--out` was typed without a folder, as by `$UNSET`."""
    expect(bool(out) or not options.is_given("--out", argv), "out", "a folder", "nothing")


def expect_folder(argument: str, path: Path) -> None:
    """Raises UsageError for `argument` unless files can be written in the folder `path`.

    It may be missing, where it can be made. Nothing is made here: a command that ends with another
    mistake leaves none behind.
    """
    expected = f"{argument}: expected a folder"
    for place in (path, *path.parents):
        try:
            place.lstat()
        except (FileNotFoundError, NotADirectoryError, PermissionError):
            continue  # the folder above it tells
        except OSError as error:
            raise config_lib.UsageError(f"{expected}, got {path}: {error.strerror}") from error
        above = place != path
        if not place.is_dir():
            why = f"; {place} is not one" if above else ""
            raise config_lib.UsageError(f"{expected}, got {path}{why}")
        if not os.access(place, os.W_OK | os.X_OK):
            why = f"; {place} may not" if above else ""
            raise config_lib.UsageError(f"{expected} that may be written, got {path}{why}")
        return


def expect_finite(settings: Any, prefix: str = "") -> None:
    """Raises UsageError for the first number of a (nested) dataclass that is nan or infinite."""
    for field in dataclasses.fields(settings):
        value, name = getattr(settings, field.name), prefix + field.name.replace("_", "-")
        if dataclasses.is_dataclass(value):
            expect_finite(value, f"{name}.")
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, float):
                expect(math.isfinite(number), name, "a finite number", number)


def expect(holds: bool, name: str, expected: str, got: Any) -> None:
    """Raises UsageError for the flag `name` unless its value `holds`."""
    if not holds:
        raise config_lib.UsageError(f"--{name}: expected {expected}, got {got}")
