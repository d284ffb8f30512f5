"""Denoising diffusion (IV-C, IV-G): a U-Net predicts noise, DDIM takes it away."""

import dataclasses
from typing import TYPE_CHECKING, Annotated

from starjax import config, errors
from starjax.learners import Learner
from starjax.limits import Count, Range

if TYPE_CHECKING:  # it imports jax, which `--help` does without
    from starjax.policies.sequences import SequenceModel, Sizes

# One DDIM step alone returns the noise that it began with (`models.schedule.ddim_table`).
FEWEST_STEPS = 2
Steps = Annotated[int, Range(FEWEST_STEPS, 1_000_000)]


@dataclasses.dataclass(frozen=True, kw_only=True)
class DiffusionConfig:
    """Options of the learner `diffusion`."""

    # of each level of the U-Net
    unet_channels: Annotated[tuple[int, ...], Range(1, 65_536)] = (256, 512, 1024, 2048)
    # of the U-Net's convolutions, in commands
    kernel_size: Annotated[int, Range(1, 4_095, step=2)] = 5
    groups: Count = 8  # of the U-Net's GroupNorms; divides all of its channels
    # width of the embedding of the diffusion step
    time_dim: Annotated[int, Range(4, 65_536, step=2)] = 128
    diffusion_steps: Steps = 100  # K, diffusion steps in training
    ddim_steps: Steps = 10  # denoising steps of a decision, at most K
    # of a sample's first noise; lower: nearer to the likeliest
    temperature: Annotated[float, Range(0.0, 1.0)] = 1.0


def check(options: DiffusionConfig, policy_config: config.PolicyConfig) -> None:
    """Raises UsageError for the first option that does not go with another."""
    levels, channels = len(options.unet_channels), options.unet_channels
    if not levels:
        raise errors.UsageError("policy.unet_channels", "at least one level", channels)
    if any(width % options.groups for width in channels):
        expected = f"multiples of policy.groups = {options.groups}"
        raise errors.UsageError("policy.unet_channels", expected, channels)
    if policy_config.horizon % (halvings := 2 ** (levels - 1)):
        expected = f"a multiple of {halvings} for {levels} U-Net levels"
        raise errors.UsageError("policy.horizon", expected, policy_config.horizon)
    if options.ddim_steps > options.diffusion_steps:
        expected = f"at most policy.diffusion_steps = {options.diffusion_steps}"
        raise errors.UsageError("policy.ddim_steps", expected, options.ddim_steps)


def make(
    options: DiffusionConfig, policy_config: config.PolicyConfig, sizes: "Sizes"
) -> "SequenceModel":
    """The model of these options."""
    import jax.numpy as jnp

    from starjax.models import process, unet1d
    from starjax.policies import denoiser

    unet = unet1d.ConditionalUnet1D(
        action_dim=sizes.action,
        cond_dim=sizes.condition,
        channels=tuple(options.unet_channels),
        kernel_size=options.kernel_size,
        groups=options.groups,
        time_dim=options.time_dim,
        dtype=jnp.dtype(policy_config.dtype),
    )
    diffusion = process.diffusion(options.diffusion_steps, options.ddim_steps)
    return denoiser.make(unet, diffusion, sizes.horizon, options.temperature)


LEARNER = Learner(DiffusionConfig, check, make)
