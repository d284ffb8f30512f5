"""Ranges of a run's settings, checked before anything heavy is imported."""

from typing import Any

from starjax import config as config_lib
from starjax.experiments import methods, options


def check(config: config_lib.RunConfig) -> None:
    """Raises UsageError for the first value that is out of its range."""
    options.choice("--method", config.method, [*methods.METHODS, "all"])
    demos, policy, train, evaluation = config.demos, config.policy, config.train, config.eval
    positive = {
        "demos.per-trocar": demos.per_trocar,
        "demos.max-steps": demos.max_steps,
        "policy.obs-horizon": policy.obs_horizon,
        "policy.execute": policy.execute,
        "policy.vision-dim": policy.vision_dim,
        "policy.state-dim": policy.state_dim,
        "policy.kernel-size": policy.kernel_size,
        "policy.groups": policy.groups,
        "policy.roll-width": policy.roll_width,
        "policy.diffusion-steps": policy.diffusion_steps,
        "train.steps": train.steps,
        "train.batch-size": train.batch_size,
        "train.learning-rate": train.learning_rate,
        "train.steps-per-call": train.steps_per_call,
        "train.checkpoint-every": train.checkpoint_every,
        "train.keep-checkpoints": train.keep_checkpoints,
        "train.log-every": train.log_every,
        "eval.trials": evaluation.trials,
        "eval.time-limit-s": evaluation.time_limit_s,
    }
    for name, value in positive.items():
        _expect(value > 0, name, "more than 0", value)
    levels, seen = len(policy.unet_channels), demos.seen_trocars
    executed = f"at most policy.horizon = {policy.horizon}"
    steps = f"1 to policy.diffusion-steps = {policy.diffusion_steps}"
    _expect(config.seed >= 0, "seed", "0 or more", config.seed)
    _expect(1 <= seen <= 8, "demos.seen-trocars", "1 to 8", seen)
    _expect(policy.image_size >= 32, "policy.image-size", "32 pixels or more", policy.image_size)
    _expect(levels >= 1, "policy.unet-channels", "at least one level", policy.unet_channels)
    _expect(
        all(channels > 0 and channels % policy.groups == 0 for channels in policy.unet_channels),
        "policy.unet-channels",
        f"multiples of policy.groups = {policy.groups}",
        policy.unet_channels,
    )
    _expect(
        policy.horizon > 0 and policy.horizon % 2 ** (levels - 1) == 0,
        "policy.horizon",
        f"a multiple of {2 ** (levels - 1)} for {levels} U-Net levels",
        policy.horizon,
    )
    _expect(policy.execute <= policy.horizon, "policy.execute", executed, policy.execute)
    _expect(
        1 <= policy.ddim_steps <= policy.diffusion_steps,
        "policy.ddim-steps",
        steps,
        policy.ddim_steps,
    )
    _expect(0 <= policy.temperature <= 1, "policy.temperature", "in [0, 1]", policy.temperature)
    if policy.freeze_encoder:
        _expect(
            policy.observation == "image",
            "policy.freeze-encoder",
            "--policy.observation image",
            policy.observation,
        )
        _expect(
            bool(policy.encoder_weights),
            "policy.freeze-encoder",
            "--policy.encoder-weights with a trained policy",
            "none",
        )
    _expect(0 < train.crop_fraction <= 1, "train.crop-fraction", "in (0, 1]", train.crop_fraction)
    _expect(0 <= train.ema_max < 1, "train.ema-max", "in [0, 1)", train.ema_max)
    _expect(train.holdout_demos >= 0, "train.holdout-demos", "0 or more", train.holdout_demos)
    _expect(evaluation.chunk >= 0, "eval.chunk", "0 or more", evaluation.chunk)
    _expect(evaluation.video_trials >= 0, "eval.video-trials", "0 or more", evaluation.video_trials)


def _expect(holds: bool, name: str, expected: str, got: Any) -> None:
    if not holds:
        raise config_lib.UsageError(f"--{name}: expected {expected}, got {got}")
