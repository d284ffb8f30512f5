"""Settings of a run as frozen dataclasses. Standard library only: `--help` must not import jax."""

import dataclasses
import types
import typing
from collections.abc import Mapping
from typing import Any, Literal, TypeVar

SettingsT = TypeVar("SettingsT")


class UsageError(ValueError):
    """A mistake of whoever typed the command: shown as one line, without a traceback."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class DemosConfig:
    """Demonstrations: how many, and what is recorded."""

    per_trocar: int = 30  # successful demonstrations at each seen trocar (V-A3)
    seen_trocars: int = 8  # how many of the eight seen trocars to train with, the first ones
    keep_failures: bool = False  # store failed episodes too; training leaves them out
    one_wall: bool = False  # on the middle row the expert always takes the wall of one side
    max_steps: int = 600  # control steps, at 30 Hz, that the expert may take


# One DDIM step alone returns the noise that it began with (`models.schedule.ddim_table`).
FEWEST_DDIM_STEPS = 2


@dataclasses.dataclass(frozen=True, kw_only=True)
class PolicyConfig:
    """Networks and diffusion (IV-G)."""

    # Pixels as in the paper, or block pose and target position
    observation: Literal["image", "state"] = "image"
    image_size: int = 256  # side of a picture in pixels, before the crop
    crop_fraction: float = 0.9  # side of the crop, random in training, over the image's
    obs_horizon: int = 2  # T_o, control steps whose observations a decision sees
    horizon: int = 16  # H, commands predicted: t+1 .. t+H
    execute: int = 8  # commands executed before re-planning
    encoder: Literal["resnet18", "small"] = "resnet18"  # network that reads the pictures
    # Where the encoder's weights begin: a policy that ships with starjax, by its name; a
    # policy.safetensors of yours; a file of torchvision's (pth or safetensors). Empty: from scratch
    encoder_weights: str = ""
    freeze_encoder: bool = False  # train the rest only, on features computed once a frame
    vision_dim: int = 512  # d_v, numbers that the encoder makes of a picture
    state_dim: int = 256  # d_s, numbers made of the low-dimensional history (Eq. 11)
    unet_channels: tuple[int, ...] = (256, 512, 1024, 2048)  # of each level of the U-Net
    kernel_size: int = 5  # of the U-Net's convolutions, in commands; odd
    groups: int = 8  # of the U-Net's GroupNorms; divides all of its channels
    time_dim: int = 128  # width of the embedding of the diffusion step
    roll_width: int = 256  # width of the roll network
    roll_blocks: int = 3  # residual blocks of the roll network
    # Ablations of the roll network, which reads tip positions, trocar and measured rolls (Eq. 13)
    roll_history: bool = True  # the roll network reads the measured rolls
    roll_trocar: bool = True  # the roll network reads the trocar
    roll_observation: bool = False  # the roll network reads the picture or the task state too
    # Whether the diffusion model is given the trocar: as Table II says, or an ablation
    sees_trocar: Literal["method", "always", "never"] = "method"
    # Which way {T} points where actions are relative to it (DP-RCM-1 and 2): turned with the
    # trocar's azimuth, or an ablation
    trocar_yaw: Literal["azimuth", "fixed"] = "azimuth"
    diffusion_steps: int = 100  # K, diffusion steps in training
    ddim_steps: int = 10  # denoising steps of a decision, 2 to K
    temperature: float = 1.0  # 0 to 1, of a sample's first noise; lower: nearer to the likeliest
    roll_loss_weight: float = 0.1  # lambda of Eq. 15
    dtype: Literal["float32", "bfloat16"] = "float32"  # of the networks' arithmetic


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Optimisation (IV-G; warm-up, betas and EMA are Diffusion Policy's)."""

    steps: int = 100_000  # training steps
    batch_size: int = 256  # samples a training step
    learning_rate: float = 1e-4  # AdamW's after the warm-up; half a cosine takes it to 0
    weight_decay: float = 1e-6  # AdamW's, of all weights
    roll_weight_decay: float = 0.0  # more of it, of the roll network's kernels alone
    warmup_steps: int = 500  # training steps in which the learning rate rises, at most half of all
    ema_max: float = 0.9999  # share of the averaged weights that a training step keeps, at most
    jitter: float = 0.1  # of pictures: brightness, contrast, saturation times 1 +- this
    image_noise: float = 0.02  # standard deviation of the noise on pictures in [0, 1]
    state_noise: float = 0.02  # standard deviation of the noise on normalised poses and task state
    steps_per_call: int = 100  # training steps handed to the device between two looks, at most
    checkpoint_every: int = 5_000  # training steps between two checkpoints
    keep_checkpoints: int = 2  # how many of the newest checkpoints stay on disk
    log_every: int = 100  # training steps between two lines of metrics.jsonl
    holdout_demos: int = 8  # demonstrations kept out of training, for the action error


@dataclasses.dataclass(frozen=True, kw_only=True)
class EvalConfig:
    """Closed-loop evaluation (V-A4)."""

    trials: int = 30  # trials at each trocar
    time_limit_s: float = 60.0  # s of simulated time that a trial may take
    chunk: int = 0  # trials between two savings, at most; 0: as many as a program runs
    video_trials: int = 4  # trials recorded for the video and the figures


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunConfig:
    """One run of `python -m starjax.experiments.run`."""

    method: str = "stardiff"  # a row of Table II, or all
    # Starting values of the rest; auto: gpu where jax can use one, else cpu
    preset: Literal["auto", "smoke", "cpu", "gpu", "compact", "paper"] = "auto"
    seed: int = 0  # of everything random
    out: str = "runs"  # folder of results; left out, other seeds and observations have their own
    demos: DemosConfig = dataclasses.field(default_factory=DemosConfig)
    policy: PolicyConfig = dataclasses.field(default_factory=PolicyConfig)
    train: TrainConfig = dataclasses.field(default_factory=TrainConfig)
    eval: EvalConfig = dataclasses.field(default_factory=EvalConfig)


def from_dict(settings: type[SettingsT], values: Mapping[str, Any]) -> SettingsT:
    """Inverse of `dataclasses.asdict`, also after a trip through JSON (which knows no tuples).

    Fields that `values` lacks keep their default; names that `settings` lacks, and values of other
    types, raise ValueError.
    """
    if not isinstance(values, Mapping):
        raise ValueError(f"{settings.__name__}: expected an object, got {values!r}")
    hints = typing.get_type_hints(settings)
    unknown = sorted(set(values) - set(hints))
    if unknown:
        raise ValueError(f"{settings.__name__}: expected {sorted(hints)}, got {unknown}")
    fields = {}
    for name, value in values.items():
        if dataclasses.is_dataclass(hints[name]):
            fields[name] = from_dict(hints[name], value)
        elif _fits(value, hints[name]):
            fields[name] = tuple(value) if isinstance(value, list) else value
        else:
            raise ValueError(
                f"{settings.__name__}.{name}: expected {_kind(hints[name])}, got {value!r}"
            )
    return settings(**fields)


def upgraded(values: Mapping[str, Any]) -> dict[str, Any]:
    """Settings of a run from JSON, or parts of them, with those of earlier versions as today's."""
    found = dict(values)
    train, policy = found.get("train"), found.get("policy")
    if isinstance(train, Mapping) and isinstance(policy, Mapping) and "crop_fraction" in train:
        rest = dict(train)
        found["policy"] = {**policy, "crop_fraction": rest.pop("crop_fraction")}
        found["train"] = rest
    return found


def _kind(hint: Any) -> str:
    """A field's type, for people."""
    if typing.get_origin(hint) is Literal:
        return f"one of {', '.join(map(str, typing.get_args(hint)))}"
    return getattr(hint, "__name__", str(hint))


def _fits(value: Any, hint: Any) -> bool:
    """Whether a value from JSON is of a field's type."""
    origin, kinds = typing.get_origin(hint), typing.get_args(hint)
    if origin is Literal:
        return value in kinds
    if origin is tuple:
        return isinstance(value, list | tuple) and all(_fits(part, kinds[0]) for part in value)
    if isinstance(hint, types.UnionType):
        return any(_fits(value, kind) for kind in kinds)
    if isinstance(value, bool):
        return hint is bool
    return isinstance(value, int | float if hint is float else hint)
