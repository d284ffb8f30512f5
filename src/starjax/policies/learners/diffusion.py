"""Denoising diffusion (IV-C, IV-G): a U-Net predicts noise, DDIM takes it away."""

import dataclasses
from typing import TYPE_CHECKING, Annotated

from starjax.core import config, errors
from starjax.core.learners import Learner
from starjax.core.limits import Range
from starjax.policies.learners import unet

if TYPE_CHECKING:  # it imports jax, which `--help` does without
    from starjax.policies.sequences import SequenceModel, Sizes

# One DDIM step alone returns the noise that it began with (`models.schedule.ddim_table`).
FEWEST_STEPS = 2
Steps = Annotated[int, Range(FEWEST_STEPS, 1_000_000)]


@dataclasses.dataclass(frozen=True, kw_only=True)
class DiffusionConfig(unet.UnetConfig):
    """Options of the learner `diffusion`."""

    diffusion_steps: Steps = 100  # K, diffusion steps in training
    ddim_steps: Steps = 10  # denoising steps of a decision, at most K


def check(options: DiffusionConfig, policy_config: config.PolicyConfig) -> None:
    """Raises UsageError for the first option that does not go with another."""
    unet.check(options, policy_config)
    if options.ddim_steps > options.diffusion_steps:
        expected = f"at most policy.diffusion_steps = {options.diffusion_steps}"
        raise errors.UsageError("policy.ddim_steps", expected, options.ddim_steps)


def make(
    options: DiffusionConfig, policy_config: config.PolicyConfig, sizes: "Sizes"
) -> "SequenceModel":
    """Builds the model of these options."""
    from starjax.policies.models import process

    diffusion = process.diffusion(options.diffusion_steps, options.ddim_steps)
    return unet.make(options, policy_config, sizes, diffusion)


LEARNER = Learner(DiffusionConfig, check, make)
