"""Settings of a run as frozen dataclasses. Imports no jax, as `--help` reads them.

A field's comment is its help text; its type has its range (`limits`).
"""

import dataclasses
import json
import typing
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, TypeVar

import msgspec

from starjax.learners import LEARNERS
from starjax.limits import INLINE, Count, CountOrZero, NotNegative, Positive, Range

SettingsT = TypeVar("SettingsT")


# A key of jax takes 32 bits: larger seeds would alias smaller ones.
Seed = Annotated[int, Range(0, 2**32 - 1)]
Preset = Literal["auto", "smoke", "cpu", "gpu", "resnet", "compact", "paper"]
TIME_LIMIT = Range(0.1, 86_400.0)  # s; a control step takes 1/30 s
DEFAULT_TASK = "peg_transfer"


@dataclasses.dataclass(frozen=True, kw_only=True)
class SceneConfig:
    """Names the parts of a scene, as `starjax list` shows them."""

    task: str = DEFAULT_TASK  # what is to be done; starjax list shows what there is
    # robots, one for each that the task asks for, or one for all; left out: the task's
    arm: tuple[str, ...] = ()
    tool: tuple[str, ...] = ()  # instruments that the arms hold; left out: the task's
    # cameras that the policy sees; left out, or fixed: the task's first. endoscope: one in a trocar
    # of its own, elsewhere in every episode
    camera: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True, kw_only=True)
class DemosConfig:
    """Demonstrations: how many, and what is recorded."""

    # folder of a dataset to learn from, such as starjax import writes; left out: the expert's
    from_: str = ""
    per_trocar: Count = 30  # successful demonstrations at each seen trocar (V-A3)
    seen_trocars: Count = 8  # of the task's, to train with, from the first on
    keep_failures: bool = False  # store failed episodes too; training leaves them out
    expert: str = ""  # which of the task's scripted demonstrators; left out, its first
    max_steps: Count = 600  # control steps, at 30 Hz, that the expert may take
    # what is wrong while they are recorded, each NAME=LEVEL with the names of starjax stress: at
    # levels that are drawn for every episode, up to these
    randomise: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True, kw_only=True)
class PolicyConfig:
    """Settings that policies of all learners share (IV-G); the learner's own options follow."""

    learner: str = "diffusion"  # how sequences of actions are generated

    # pixels as in the paper, or what the task says of its state
    observation: Literal["image", "state"] = "image"
    image_size: Annotated[int, Range(32, 4_096)] = 256  # pixels a side of an image, before the crop
    # side of the crop, random in training, over the image's
    crop_fraction: Annotated[float, Range(0.0, 1.0, "(]")] = 0.9
    obs_horizon: Count = 2  # T_o, control steps whose observations a decision sees
    horizon: Annotated[int, Range(1, 4_096)] = 16  # H, commands predicted: t+1 .. t+H
    execute: Count = 8  # commands executed before re-planning
    encoder: Literal["resnet18", "small"] = "resnet18"  # network that reads the images
    # where the encoder's weights begin: a policy that ships with starjax, by its name; a
    # policy.safetensors of yours; a .safetensors of a ResNet-18 (ImageNet). Empty: from scratch
    encoder_weights: str = ""
    freeze_encoder: bool = False  # train the rest only, on features computed once a frame
    vision_dim: Annotated[int, Range(2, 65_536)] = 512  # d_v, numbers that an image becomes
    # d_s, numbers that the low-dimensional history becomes (Eq. 11)
    state_dim: Annotated[int, Range(4, 65_536)] = 256
    roll_width: Annotated[int, Range(1, 65_536)] = 256  # width of the roll network
    roll_blocks: Annotated[int, Range(0, 1_000)] = 3  # residual blocks of the roll network
    # Ablations of the roll network, which reads tip positions, trocar and measured rolls (Eq. 13)
    roll_history: bool = True  # the roll network reads the measured rolls
    roll_trocar: bool = True  # the roll network reads the trocar
    roll_observation: bool = False  # the roll network reads the image or the task state too
    # whether the learner's model is given the trocar: as the method says, or an ablation
    sees_trocar: Literal["method", "always", "never"] = "method"
    # which way {T} points where actions are relative to it (DP-RCM-1 and 2): turned with the
    # trocar's azimuth, or an ablation
    trocar_yaw: Literal["azimuth", "fixed"] = "azimuth"
    roll_loss_weight: NotNegative = 0.1  # lambda of Eq. 15
    # of the networks' arithmetic in training; a trained policy decides in float32
    dtype: Literal["float32", "bfloat16"] = "float32"
    # Of the learner, see `learners.Learner`; None: its defaults. In JSON, and as flags, they stand
    # among the others.
    options: Any = dataclasses.field(default=None, metadata=INLINE)

    def __post_init__(self) -> None:
        settings = LEARNERS.get(self.learner).settings
        if self.options is None:
            object.__setattr__(self, "options", settings())
        elif not isinstance(self.options, settings):
            got = type(self.options).__name__
            raise ValueError(f"options: expected {settings.__name__}, got {got}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Optimisation (IV-G; warm-up, betas and EMA are Diffusion Policy's)."""

    steps: Count = 100_000  # training steps
    batch_size: Count = 256  # samples a training step
    learning_rate: Positive = 1e-4  # AdamW's after the warm-up; half a cosine takes it to 0
    weight_decay: NotNegative = 1e-6  # AdamW's, of all weights
    roll_weight_decay: NotNegative = 0.0  # more of it, of the roll network's kernels alone
    # training steps in which the learning rate rises, at most half of all
    warmup_steps: CountOrZero = 500
    # share of the averaged weights that a training step keeps, at most
    ema_max: Annotated[float, Range(0.0, 1.0, "[)")] = 0.9999
    jitter: NotNegative = 0.1  # of images: brightness, contrast, saturation times 1 +- this
    image_noise: NotNegative = 0.02  # standard deviation of the noise on images in [0, 1]
    # standard deviation of the noise on normalised poses and task state
    state_noise: NotNegative = 0.02
    # training steps handed to the device between two looks, at most
    steps_per_call: Count = 100
    checkpoint_every: Count = 5_000  # training steps between two checkpoints
    keep_checkpoints: Count = 2  # how many of the newest checkpoints stay on disk
    log_every: Count = 100  # training steps between two lines of metrics.jsonl
    # demonstrations kept out of training, for the action error
    holdout_demos: CountOrZero = 8


@dataclasses.dataclass(frozen=True, kw_only=True)
class EvalConfig:
    """Closed-loop evaluation (V-A4)."""

    trials: Annotated[int, Range(1, 1_000_000)] = 30  # trials at each trocar
    time_limit_s: Annotated[float, TIME_LIMIT] = 60.0  # s of simulated time that a trial may take
    chunk: CountOrZero = 0  # trials between two savings, at most; 0: as many as a program runs
    video_trials: CountOrZero = 4  # trials recorded for the video and the figures
    # plan at every control step, and execute the mean of all plans for the moment, as ACT does
    ensemble: bool = False


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunConfig:
    """One run of `python -m starjax.experiments.run`."""

    method: str = "stardiff"  # of starjax list; all: the eight of Table II
    # starting values of the rest; auto: gpu where jax can use one, else cpu
    preset: Preset = "auto"
    seed: Seed = 0  # of everything random
    out: str = "auto"  # folder of results; auto: runs/PRESET; other scenes, images and seeds apart
    scene: SceneConfig = dataclasses.field(default_factory=SceneConfig)
    demos: DemosConfig = dataclasses.field(default_factory=DemosConfig)
    policy: PolicyConfig = dataclasses.field(default_factory=PolicyConfig)
    train: TrainConfig = dataclasses.field(default_factory=TrainConfig)
    eval: EvalConfig = dataclasses.field(default_factory=EvalConfig)


# What decides a policy's weights; the rest may change between two starts of a run.
_WEIGHT_SECTIONS = ("seed", "scene", "demos", "policy", "train")
_NOT_OF_WEIGHTS = {
    "train.keep_checkpoints",
    "train.checkpoint_every",
    "train.steps_per_call",
}  # of those


def weight_settings(config: RunConfig) -> dict[str, Any]:
    """The settings that decide a policy's weights, e.g. `train.steps`, as JSON has them."""
    values = as_json(config)
    flat = _flat({name: values[name] for name in _WEIGHT_SECTIONS})
    return {name: value for name, value in flat.items() if name not in _NOT_OF_WEIGHTS}


def differing_settings(configs: Sequence[Mapping[str, Any]]) -> list[str]:
    """Settings, but for the seed, that decide weights and that configurations disagree on.

    The configurations are from JSON. Settings that one of them lacks have their default there.
    """
    usual = as_json(RunConfig())
    parts = [part for part in _WEIGHT_SECTIONS if part != "seed"]
    filled = [{part: usual[part] | old.get(part, {}) for part in parts} for old in configs]
    rows = [_flat(values | {"policy": _without_frame(values["policy"])}) for values in filled]
    return [
        name
        for name in dict.fromkeys(name for row in rows for name in row)
        if name not in _NOT_OF_WEIGHTS and any(row.get(name) != rows[0].get(name) for row in rows)
    ]


def with_learner(policy: PolicyConfig, learner: str) -> PolicyConfig:
    """The settings with another learner, whose options are as they were where both have them."""
    settings = LEARNERS.get(learner).settings
    ours, theirs = (
        {field.name for field in dataclasses.fields(one)} for one in (policy.options, settings)
    )
    kept = {name: getattr(policy.options, name) for name in ours & theirs}
    return dataclasses.replace(policy, learner=learner, options=settings(**kept))


def inference_settings(policy: PolicyConfig) -> PolicyConfig:
    """Settings of a policy once it is trained: it decides in float32.

    In bfloat16 a tool at rest would tremble by 0.1 mm a control step, which is 4 mm/s.
    """
    return dataclasses.replace(policy, dtype="float32")


def with_options(policy: PolicyConfig, **changed: Any) -> PolicyConfig:
    """The settings with some of the learner's options changed."""
    return dataclasses.replace(policy, options=dataclasses.replace(policy.options, **changed))


def as_json(settings: Any) -> dict[str, Any]:
    """Settings as values of JSON, which knows no tuples."""
    return json.loads(json.dumps(_plain(settings)))


def _plain(settings: Any) -> dict[str, Any]:
    found = {}
    for field in dataclasses.fields(settings):
        value = getattr(settings, field.name)
        if not dataclasses.is_dataclass(value):
            found[field.name] = value
        elif field.metadata == INLINE:
            found |= _plain(value)
        else:
            found[field.name] = _plain(value)
    return found


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    found = {}
    for name, value in values.items():
        inner = isinstance(value, dict)
        found |= _flat(value, f"{prefix}{name}.") if inner else {f"{prefix}{name}": value}
    return found


def from_dict(settings: type[SettingsT], values: Mapping[str, Any]) -> SettingsT:
    """Inverse of `as_json`.

    Fields that `values` lacks keep their default; names that `settings` lacks, and values of other
    types, raise ValueError.
    """
    if not isinstance(values, Mapping):
        raise ValueError(f"{settings.__name__}: expected an object, got {values!r}")
    hints = typing.get_type_hints(settings)
    if settings is PolicyConfig:
        values = _nested(values)
        hints["options"] = type(values["options"])
    unknown = sorted(set(values) - set(hints))
    if unknown:
        raise ValueError(f"{settings.__name__}: expected {sorted(hints)}, got {unknown}")
    fields = {}
    for name, value in values.items():
        if dataclasses.is_dataclass(value):
            fields[name] = value
        elif dataclasses.is_dataclass(hints[name]):
            fields[name] = from_dict(hints[name], value)
        else:
            try:
                fields[name] = msgspec.convert(value, hints[name])
            except msgspec.ValidationError as error:
                raise ValueError(f"{settings.__name__}.{name}: {error}") from error
    return settings(**fields)


def _nested(policy: Mapping[str, Any]) -> dict[str, Any]:
    """A policy's settings with the learner's options by themselves."""
    if (frame := policy.get("frame", "world")) != "world":
        raise ValueError(f"PolicyConfig.frame: expected world, the only frame left, got {frame!r}")
    policy = _without_frame(policy)
    learner = policy.get("learner", PolicyConfig.learner)
    if not isinstance(learner, str):
        raise ValueError(f"PolicyConfig.learner: expected str, got {learner!r}")
    settings = LEARNERS.get(learner).settings
    shared = {field.name for field in dataclasses.fields(PolicyConfig)} - {"options"}
    options = {name: value for name, value in policy.items() if name not in shared}
    rest = {name: value for name, value in policy.items() if name in shared}
    return {**rest, "options": from_dict(settings, options)}


def _without_frame(policy: Mapping[str, Any]) -> dict[str, Any]:
    """Returns a policy's settings without the frame of its positions where that is the world.

    Version 0.2.0 knew another one, the endoscope's, in which policies learned less.
    """
    return {name: value for name, value in policy.items() if (name, value) != ("frame", "world")}
