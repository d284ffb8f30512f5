"""Flow matching that learns to decide in one network evaluation, distilled while it is trained.

Not in the paper. Sources: `models.shortcut`.
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
class OnestepConfig(unet.UnetConfig):
    """Options of the learner `onestep`."""

    # time, from 1 (noise) to 0, at which a second evaluation corrects a sample; 0: one evaluation
    correct_at: Annotated[float, Range(0.0, 1.0, "[)")] = 0.0


def make(
    options: OnestepConfig, policy_config: config.PolicyConfig, sizes: "Sizes"
) -> "SequenceModel":
    """Builds the model of these options."""
    from starjax.policies.models import process

    return unet.make(options, policy_config, sizes, process.shortcut(options.correct_at))


LEARNER = Learner(OnestepConfig, unet.check, make)
