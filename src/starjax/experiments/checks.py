"""Ranges of a run's settings, and its folder, checked before anything heavy is imported."""

import dataclasses
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from starjax import config as config_lib
from starjax import errors, methods
from starjax.experiments import options

SEEDS = 2**32  # a key of jax takes 32 bits: larger seeds would be those of others again
LEAST_TIME_S, MOST_TIME_S = 0.1, 86_400.0  # of a trial; one control step takes 1/30 s
MOST_TRIALS = 1_000_000
MOST_COUNT = 2**31 - 1  # whole numbers of compiled programs have 32 bits
# More is a slip of the hand, and would be traced for hours or fill the memory.
_MOST = {
    "policy.image_size": 4_096,  # pixels
    "policy.horizon": 4_096,
    "policy.vision_dim": 65_536,
    "policy.state_dim": 65_536,
    "policy.unet_channels": 65_536,
    "policy.kernel_size": 4_095,
    "policy.time_dim": 65_536,
    "policy.roll_width": 65_536,
    "policy.roll_blocks": 1_000,
    "policy.diffusion_steps": 1_000_000,
}
_CELL = {"resnet18": 32, "small": 8}  # pixels that a vision encoder makes one of its maps' cells


def check(config: config_lib.RunConfig) -> None:
    """Raises UsageError for the first value that is out of its range."""
    errors.choice("method", config.method, [*methods.METHODS, "all"])
    expect_finite(config)
    demos, policy, train, evaluation = config.demos, config.policy, config.train, config.eval
    positive = {
        "demos.per_trocar": demos.per_trocar,
        "demos.max_steps": demos.max_steps,
        "policy.obs_horizon": policy.obs_horizon,
        "policy.execute": policy.execute,
        "policy.groups": policy.groups,
        "policy.roll_width": policy.roll_width,
        "train.steps": train.steps,
        "train.batch_size": train.batch_size,
        "train.learning_rate": train.learning_rate,
        "train.steps_per_call": train.steps_per_call,
        "train.checkpoint_every": train.checkpoint_every,
        "train.keep_checkpoints": train.keep_checkpoints,
        "train.log_every": train.log_every,
    }
    for name, value in positive.items():
        expect(value > 0, name, "more than 0", value)
    not_negative = {
        "policy.roll_blocks": policy.roll_blocks,
        "policy.roll_loss_weight": policy.roll_loss_weight,
        "train.weight_decay": train.weight_decay,
        "train.roll_weight_decay": train.roll_weight_decay,
        "train.warmup_steps": train.warmup_steps,
        "train.jitter": train.jitter,
        "train.image_noise": train.image_noise,
        "train.state_noise": train.state_noise,
        "train.holdout_demos": train.holdout_demos,
        "eval.chunk": evaluation.chunk,
        "eval.video_trials": evaluation.video_trials,
    }
    for name, value in not_negative.items():
        expect(value >= 0, name, "0 or more", value)
    expect(0 <= config.seed < SEEDS, "seed", f"0 to {SEEDS - 1}", config.seed)
    seen, fraction = demos.seen_trocars, train.crop_fraction
    expect(1 <= seen <= 8, "demos.seen_trocars", "1 to 8", seen)
    expect(0 < fraction <= 1, "train.crop_fraction", "in (0, 1]", fraction)
    expect(0 <= train.ema_max < 1, "train.ema_max", "in [0, 1)", train.ema_max)
    _check_sizes(config)
    _check_networks(policy)
    _check_sampling(policy)
    _check_encoder(policy, fraction)
    trials, seconds = evaluation.trials, evaluation.time_limit_s
    limits = f"{LEAST_TIME_S:g} to {MOST_TIME_S:g} s"
    expect(1 <= trials <= MOST_TRIALS, "eval.trials", f"1 to {MOST_TRIALS}", trials)
    expect(LEAST_TIME_S <= seconds <= MOST_TIME_S, "eval.time_limit_s", limits, seconds)


def _check_sizes(config: config_lib.RunConfig) -> None:
    for part in ("demos", "policy", "train", "eval"):
        for field, value in vars(getattr(config, part)).items():
            name = f"{part}.{field}"
            most = _MOST.get(name, MOST_COUNT)
            for number in value if isinstance(value, tuple) else (value,):
                fits = not isinstance(number, int) or number <= most
                expect(fits, name, f"at most {most}", number)


def _check_networks(policy: config_lib.PolicyConfig) -> None:
    levels, kernel, width = len(policy.unet_channels), policy.kernel_size, policy.time_dim
    expect(policy.vision_dim >= 2, "policy.vision_dim", "2 or more", policy.vision_dim)
    expect(policy.state_dim >= 4, "policy.state_dim", "4 or more", policy.state_dim)
    expect(kernel > 0 and kernel % 2 == 1, "policy.kernel_size", "an odd number above 0", kernel)
    expect(width >= 4 and width % 2 == 0, "policy.time_dim", "an even number, 4 or more", width)
    expect(levels >= 1, "policy.unet_channels", "at least one level", policy.unet_channels)
    expect(
        all(channels > 0 and channels % policy.groups == 0 for channels in policy.unet_channels),
        "policy.unet_channels",
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
    expect(diffusion >= fewest, "policy.diffusion_steps", f"{fewest} or more", diffusion)
    steps = f"{fewest} to policy.diffusion_steps = {policy.diffusion_steps}"
    expect(policy.execute <= policy.horizon, "policy.execute", executed, policy.execute)
    observed = f"at most policy.execute + 1 = {policy.execute + 1}"
    expect(
        policy.obs_horizon <= policy.execute + 1, "policy.obs_horizon", observed, policy.obs_horizon
    )
    expect(
        fewest <= policy.ddim_steps <= policy.diffusion_steps,
        "policy.ddim_steps",
        steps,
        policy.ddim_steps,
    )
    expect(0 <= policy.temperature <= 1, "policy.temperature", "in [0, 1]", policy.temperature)


def _check_encoder(policy: config_lib.PolicyConfig, crop_fraction: float) -> None:
    expect(policy.image_size >= 32, "policy.image_size", "32 pixels or more", policy.image_size)
    if policy.observation == "image":
        cell, crop = _CELL[policy.encoder], round(policy.image_size * crop_fraction)
        expect(
            crop > cell,
            "policy.image_size",
            f"more than {cell} pixels left by train.crop_fraction = {crop_fraction:g}",
            crop,
        )
    if policy.freeze_encoder:
        expect(
            policy.observation == "image",
            "policy.freeze_encoder",
            "policy.observation image",
            policy.observation,
        )
        expect(
            bool(policy.encoder_weights),
            "policy.freeze_encoder",
            "policy.encoder_weights with a trained policy",
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
    for place in (path, *path.parents):
        try:
            place.lstat()
        except (FileNotFoundError, NotADirectoryError, PermissionError):
            continue  # the folder above it tells
        except OSError as error:
            raise errors.UsageError(argument, "a folder", f"{path}: {error.strerror}") from error
        above = place != path
        if not place.is_dir():
            raise errors.UsageError(argument, "a folder", path, f"{place} is not one" * above)
        if not os.access(place, os.W_OK | os.X_OK):
            expected = "a folder that may be written"
            raise errors.UsageError(argument, expected, path, f"{place} may not" * above)
        return


def expect_finite(settings: Any, prefix: str = "") -> None:
    """Raises UsageError for the first number of a (nested) dataclass that is nan or infinite."""
    for field in dataclasses.fields(settings):
        value, name = getattr(settings, field.name), prefix + field.name
        if dataclasses.is_dataclass(value):
            expect_finite(value, f"{name}.")
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, float):
                expect(math.isfinite(number), name, "a finite number", number)


def expect(holds: bool, name: str, expected: str, got: Any) -> None:
    """Raises UsageError for the setting `name` unless its value `holds`."""
    if not holds:
        raise errors.UsageError(name, expected, got)
