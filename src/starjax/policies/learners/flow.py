"""Flow matching: the U-Net of `diffusion` predicts a velocity, a few Euler steps follow it.

Not in the paper. Sources: `models.flow`.
"""

import dataclasses
from typing import TYPE_CHECKING, Annotated

from starjax.core import config
from starjax.core.learners import Learner
from starjax.core.limits import Range
from starjax.policies.learners import unet

if TYPE_CHECKING:  # it imports jax, which `--help` does without
    from starjax.policies.sequences import SequenceModel, Sizes


@dataclasses.dataclass(frozen=True, kw_only=True)
class FlowConfig(unet.UnetConfig):
    """Options of the learner `flow`."""

    euler_steps: Annotated[int, Range(1, 1_000)] = 10  # steps of a decision


def make(
    options: FlowConfig, policy_config: config.PolicyConfig, sizes: "Sizes"
) -> "SequenceModel":
    """Builds the model of these options."""
    from starjax.policies.models import process

    return unet.make(options, policy_config, sizes, process.flow(options.euler_steps))


LEARNER = Learner(FlowConfig, unet.check, make)
