"""Settings of a run as frozen dataclasses. Imports no jax, as `--help` reads them.

A field's comment is its help text; its type has its range (`limits`).
"""

import dataclasses
from typing import Annotated, Any, Literal

from starjax.core import errors
from starjax.core.learners import LEARNERS
from starjax.core.limits import INLINE, Count, CountOrZero, NotNegative, Positive, Range

# A key of jax has 32 bits: larger seeds would alias smaller ones.
Seed = Annotated[int, Range(0, 2**32 - 1)]
SeedOrNone = Annotated[int | None, Range(0, 2**32 - 1)]
TIME_LIMIT = Range(0.1, 86_400.0)  # s; a control step takes 1/30 s
DEFAULT_TASK = "peg_transfer"


@dataclasses.dataclass(frozen=True, kw_only=True)
class SceneConfig:
    """Parts of a scene by their names in `starjax list`."""

    task: str = DEFAULT_TASK  # task (see starjax list)
    # robots, one per arm slot of the task, or one for all; default: the task's
    arm: tuple[str, ...] = ()
    tool: tuple[str, ...] = ()  # instruments of the arms; default: the task's
    # cameras of the policy; default and fixed: the task's first; endoscope: a camera in a trocar of
    # its own, with a new pose in every episode
    camera: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True, kw_only=True)
class DemosConfig:
    """Number and content of demonstrations."""

    # directory of a dataset to train on, e.g. from starjax import; default: the expert's
    from_: str = ""
    per_trocar: Count = 30  # successful demonstrations per seen trocar (V-A3)
    # number of seen trocar configurations to train on, in task order
    seen_trocars: Count = 8
    keep_failures: bool = False  # also store failed episodes, which training ignores
    expert: str = ""  # scripted demonstrator; default: the task's first
    max_steps: Count = 600  # maximum control steps per episode, at 30 Hz
    # disturbances of the motion while recording, NAME=MAX_LEVEL as in starjax stress; levels are
    # uniform per episode
    randomise: tuple[str, ...] = ()


@dataclasses.dataclass(frozen=True, kw_only=True)
class PolicyConfig:
    """Settings shared by all learners (IV-G); the options of the learner follow."""

    learner: str = "diffusion"  # generator of action sequences (see starjax list)

    # pixels as in the paper, or the state of the task
    observation: Literal["image", "state"] = "image"
    # width and height of an image in pixels, before the crop
    image_size: Annotated[int, Range(32, 4_096)] = 256
    # side of the crop as a fraction of the image; its position is random in training
    crop_fraction: Annotated[float, Range(0.0, 1.0, "(]")] = 0.9
    obs_horizon: Count = 2  # observation horizon T_o, in control steps
    horizon: Annotated[int, Range(1, 4_096)] = 16  # prediction horizon H: commands t+1 .. t+H
    execute: Count = 8  # commands executed before re-planning
    encoder: str = "resnet18"  # image encoder (see starjax list)
    # initial weights of the encoder: name of a packaged policy, a policy.safetensors, or a
    # .safetensors of a ResNet-18 (ImageNet); empty: random
    encoder_weights: str = ""
    # train the other networks only, on features computed once per frame
    freeze_encoder: bool = False
    # encoder of views of depth, e.g. points; default: the network of the other images
    depth_encoder: str = ""
    vision_dim: Annotated[int, Range(2, 65_536)] = 512  # image feature size d_v
    # feature size d_s of the low-dimensional history (Eq. 11)
    state_dim: Annotated[int, Range(4, 65_536)] = 256
    roll_width: Annotated[int, Range(1, 65_536)] = 256  # width of the roll network
    roll_blocks: Annotated[int, Range(0, 1_000)] = 3  # residual blocks of the roll network
    # Ablations of the roll network, which reads tip positions, trocar and measured rolls (Eq. 13)
    roll_history: bool = True  # give the measured rolls to the roll network
    roll_trocar: bool = True  # give the trocar to the roll network
    roll_observation: bool = False  # give the image or task state to the roll network
    # conditioning of the learner's model on the trocar: as the method defines, or an ablation
    sees_trocar: Literal["method", "always", "never"] = "method"
    # yaw of frame {T} in actions relative to it (DP-RCM-1 and 2): the trocar's azimuth, or an
    # ablation
    trocar_yaw: Literal["azimuth", "fixed"] = "azimuth"
    roll_loss_weight: NotNegative = 0.1  # loss weight lambda of the roll network (Eq. 15)
    # arithmetic of the networks in training; inference always uses float32
    dtype: Literal["float32", "bfloat16"] = "float32"
    # Options of the learner, see `learners.Learner`; None: its defaults. In JSON and as flags they
    # are on the level of the fields above.
    options: Any = dataclasses.field(default=None, metadata=INLINE)

    def __post_init__(self) -> None:
        settings = LEARNERS.get(self.learner).settings
        own = {field.name for field in dataclasses.fields(PolicyConfig)}
        if taken := sorted(own & {field.name for field in dataclasses.fields(settings)}):
            argument = f"learner {self.learner}: options of {settings.__name__}"
            raise errors.UsageError(argument, "names that PolicyConfig lacks", ", ".join(taken))
        if self.options is None:
            object.__setattr__(self, "options", settings())
        elif not isinstance(self.options, settings):
            got = type(self.options).__name__
            raise ValueError(f"options: expected {settings.__name__}, got {got}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """Optimisation (IV-G; warm-up, betas and EMA as in Diffusion Policy)."""

    steps: Count = 100_000  # training steps
    batch_size: Count = 256  # samples per training step
    # peak learning rate of AdamW; it decays to 0 along half a cosine
    learning_rate: Positive = 1e-4
    weight_decay: NotNegative = 1e-6  # weight decay of AdamW for all weights
    roll_weight_decay: NotNegative = 0.0  # additional weight decay of the roll network's kernels
    # training steps of the linear warm-up, at most half of all
    warmup_steps: CountOrZero = 500
    # maximum EMA decay
    ema_max: Annotated[float, Range(0.0, 1.0, "[)")] = 0.9999
    # image augmentation: brightness, contrast and saturation times 1 +- this
    jitter: NotNegative = 0.1
    image_noise: NotNegative = 0.02  # standard deviation of the noise on images in [0, 1]
    # disturbances of images, cameras and observations, NAME=MAX_LEVEL as in starjax stress; half
    # the samples have each with probability one half, at a uniform level
    randomise: tuple[str, ...] = ()
    # standard deviation of the noise on normalised poses and task state
    state_noise: NotNegative = 0.02
    # maximum training steps per device call
    steps_per_call: Count = 100
    checkpoint_every: Count = 5_000  # training steps between checkpoints
    keep_checkpoints: Count = 2  # number of newest checkpoints to keep
    log_every: Count = 100  # training steps between lines of metrics.jsonl
    # control steps between the windows of a demonstration; 1 trains on all of them
    window_stride: Count = 1
    # skips windows that begin among at least so many commands without motion, where a policy may
    # learn to wait; 0: none
    skip_still: CountOrZero = 0
    # demonstrations held out to measure the action error
    holdout_demos: CountOrZero = 8


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrialsConfig:
    """Closed-loop evaluation (V-A4)."""

    trials: Annotated[int, Range(1, 1_000_000)] = 30  # trials per trocar
    time_limit_s: Annotated[float, TIME_LIMIT] = 60.0  # time limit of a trial in simulated seconds
    chunk: CountOrZero = 0  # trials per saved chunk; 0: one full batch
    video_trials: CountOrZero = 4  # recorded trials for the video and figures
    # replan at every control step and execute the mean of all plans, as ACT does
    ensemble: bool = False


@dataclasses.dataclass(frozen=True, kw_only=True)
class EvalConfig(TrialsConfig):
    """Closed-loop evaluation (V-A4)."""

    # random seed of the trials; default: that of the run. Runs of several seeds meet the same
    # trials, and can be compared trial by trial, if it is fixed
    seed: SeedOrNone = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class RunConfig:
    """Settings of `starjax run`."""

    # method (see starjax list), several as a,b, or all for Table II; they share demonstrations and
    # report
    method: str = "stardiff"
    # default values of the other settings (see starjax list); auto: gpu if jax uses one, else cpu
    preset: str = "auto"
    seed: Seed = 0  # random seed of demonstrations, training and trials
    # output directory; auto: runs/PRESET, with a suffix for other scenes and seeds
    out: str = "auto"
    scene: SceneConfig = dataclasses.field(default_factory=SceneConfig)
    demos: DemosConfig = dataclasses.field(default_factory=DemosConfig)
    policy: PolicyConfig = dataclasses.field(default_factory=PolicyConfig)
    train: TrainConfig = dataclasses.field(default_factory=TrainConfig)
    eval: EvalConfig = dataclasses.field(default_factory=EvalConfig)

    @property
    def trial_seed(self) -> int:
        """Seed of the trials."""
        return self.seed if self.eval.seed is None else self.eval.seed


def with_learner(policy: PolicyConfig, learner: str) -> PolicyConfig:
    """Returns the settings with another learner; options of both learners keep their values."""
    settings = LEARNERS.get(learner).settings
    before, after = (
        {field.name for field in dataclasses.fields(kind)} for kind in (policy.options, settings)
    )
    shared = {name: getattr(policy.options, name) for name in before & after}
    return dataclasses.replace(policy, learner=learner, options=settings(**shared))


def inference_settings(policy: PolicyConfig) -> PolicyConfig:
    """Returns the settings of a trained policy, which computes in float32.

    In bfloat16 a tool at rest would tremble by 0.1 mm per control step, which is 4 mm/s.
    """
    return dataclasses.replace(policy, dtype="float32")


def with_options(policy: PolicyConfig, **changed: Any) -> PolicyConfig:
    """Returns the settings with some options of the learner changed."""
    return dataclasses.replace(policy, options=dataclasses.replace(policy.options, **changed))
