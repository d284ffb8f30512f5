"""Flow matching that learns to decide in one network evaluation, distilled while it is trained.

Not in the paper. Sources: `models.shortcut`.
"""

import dataclasses
from typing import TYPE_CHECKING

from starjax import config
from starjax.learners import Learner
from starjax.policies.learners import unet

if TYPE_CHECKING:  # it imports jax, which `--help` does without
    from starjax.policies.sequences import SequenceModel, Sizes


@dataclasses.dataclass(frozen=True, kw_only=True)
class OnestepConfig(unet.UnetConfig):
    """Options of the learner `onestep`."""


def make(
    options: OnestepConfig, policy_config: config.PolicyConfig, sizes: "Sizes"
) -> "SequenceModel":
    """Builds the model of these options."""
    from starjax.models import process

    return unet.make(options, policy_config, sizes, process.shortcut())


LEARNER = Learner(OnestepConfig, unet.check, make)
