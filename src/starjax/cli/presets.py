"""Presets: starting values of a run, any field of which the command line can override.

Each preset is a literal with its changes of `config.RunConfig()`, the paper's settings.
Other learners keep the options that they share with the preset's (`config.with_learner`).
Other packages add theirs by an entry point of the group `starjax.presets` that names a `RunConfig`.
"""

import dataclasses
from typing import NamedTuple

from starjax.core.config import DemosConfig, EvalConfig, PolicyConfig, RunConfig, TrainConfig
from starjax.core.registry import Registry, Rows
from starjax.policies.learners.diffusion import DiffusionConfig
from starjax.policies.learners.flow import FlowConfig
from starjax.runtime import gpu

_BUILT_IN: dict[str, RunConfig] = {
    # Every stage once, too short to learn anything.
    "smoke": RunConfig(
        preset="smoke",
        demos=DemosConfig(per_trocar=1),
        policy=PolicyConfig(
            observation="state",
            image_size=64,
            encoder="small",
            vision_dim=64,
            state_dim=64,
            roll_width=64,
            options=DiffusionConfig(unet_channels=(32, 64), time_dim=32),
        ),
        train=TrainConfig(
            steps=40,
            batch_size=32,
            learning_rate=3e-4,
            warmup_steps=10,
            steps_per_call=20,
            checkpoint_every=20,
            log_every=20,
            holdout_demos=1,
        ),
        eval=EvalConfig(trials=1, time_limit_s=4.0, video_trials=1),
    ),
    # Two cores, some minutes, a policy that works. No encoder learns to see in that time: it comes
    # from the compact policy, which learned this task on a GPU. A training step is bound by its
    # matrix products, so the U-Net is small.
    "cpu": RunConfig(
        preset="cpu",
        # Without images, demonstrations cost little: four times the paper's number, with windows
        # from one frame in eight, since neighbouring windows teach nearly the same.
        demos=DemosConfig(per_trocar=120, expert="one_wall"),
        policy=PolicyConfig(
            learner="flow",
            image_size=128,
            encoder="small",
            encoder_weights="compact",
            freeze_encoder=True,
            vision_dim=128,
            options=FlowConfig(
                unet_channels=(32, 64, 96), kernel_size=3, time_dim=64, temperature=0.1
            ),
        ),
        train=TrainConfig(
            steps=5_200,
            batch_size=128,
            learning_rate=4e-3,
            warmup_steps=300,
            window_stride=8,
            state_noise=0.003,
            ema_max=0.998,
            checkpoint_every=1_000,
            log_every=100,
        ),
        # No success in experiments/main_job/cpu took 19 s; a failure takes the whole limit.
        eval=EvalConfig(trials=6, time_limit_s=20.0, video_trials=4),
    ),
    # One modern GPU, some minutes: the encoder of the compact policy, as in `cpu`, and a network of
    # that policy's size, which flow matching trains to the goal in few steps.
    "gpu": RunConfig(
        preset="gpu",
        demos=DemosConfig(per_trocar=100),
        policy=PolicyConfig(
            learner="flow",
            image_size=128,
            encoder="small",
            encoder_weights="compact",
            freeze_encoder=True,
            vision_dim=128,
            dtype="bfloat16",
            options=FlowConfig(unet_channels=(64, 128, 224), time_dim=64, temperature=0.5),
        ),
        train=TrainConfig(
            steps=8_000,
            learning_rate=1e-3,
            window_stride=2,
            state_noise=0.005,
            ema_max=0.9995,
            checkpoint_every=4_000,
        ),
        # No success in experiments/main_job/gpu took 10 s; a failure takes the whole limit.
        eval=EvalConfig(time_limit_s=30.0),
    ),
    # One modern GPU, six minutes: the paper's learner and its encoder from scratch. With its
    # 240 demonstrations the roll network would overfit.
    "resnet": RunConfig(
        preset="resnet",
        demos=DemosConfig(per_trocar=100),
        policy=PolicyConfig(
            image_size=128,
            dtype="bfloat16",
            options=DiffusionConfig(unet_channels=(256, 512, 1024), temperature=0.5),
        ),
        train=TrainConfig(
            steps=16_000,
            learning_rate=3e-4,
            state_noise=0.005,
            ema_max=0.9995,
            checkpoint_every=4_000,
        ),
    ),
    # One modern GPU: a policy small enough to be carried to a laptop, from more demonstrations.
    "compact": RunConfig(
        preset="compact",
        demos=DemosConfig(per_trocar=100),
        policy=PolicyConfig(
            image_size=128,
            encoder="small",
            vision_dim=128,
            dtype="bfloat16",
            options=DiffusionConfig(unet_channels=(64, 128, 224), time_dim=64, temperature=0.5),
        ),
        train=TrainConfig(
            steps=40_000,
            learning_rate=5e-4,
            state_noise=0.005,
            ema_max=0.9995,
            checkpoint_every=10_000,
        ),
    ),
    # The paper: 100k iterations, batch 256, 256 x 256 pixels.
    "paper": RunConfig(preset="paper"),
}
PRESETS = Rows(
    Registry("preset", _BUILT_IN, "starjax.core.config:RunConfig"),
    lambda name, row: dataclasses.replace(row, preset=name),
)
# Executed commands per plan of tasks whose target moves: with the eight of other tasks, endoscope
# tracking fails in 599 of 600 trials (experiments/trocar_benchmark).
EXECUTE = {"endoscope_track": 2}


class Timing(NamedTuple):
    """Measured time of a preset's run from an empty cache.

    Attributes:
      machine: its name in words.
      backend: its name in jax.
      seconds: wall-clock time of the whole command.
      source: result of the run, below `experiments/`.
    """

    machine: str
    backend: str
    seconds: float
    source: str


TIMINGS = {
    "cpu": Timing("2 cores of an AMD EPYC", "cpu", 456.0, "main_job/cpu/run.json"),
    "gpu": Timing("an NVIDIA H200 with 16 cores", "gpu", 195.3, "main_job/gpu/encoder_0.json"),
}


def resolve(name: str, has_gpu: bool) -> RunConfig:
    """Returns the values of a preset; `auto` is `gpu` where jax has one, else `cpu`."""
    return PRESETS[("gpu" if has_gpu else "cpu") if name == "auto" else name]


def reason(has_gpu: bool) -> str:
    """Returns the reason for the preset of `auto` in one line; jax has started."""
    if has_gpu:
        return "jax runs on a GPU"
    why = gpu.why_unused()
    shown = f", not on the GPU that the system shows: {why}" if why else ""
    return f"jax runs on the CPU{shown}"
