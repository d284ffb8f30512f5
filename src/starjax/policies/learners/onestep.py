"""Shortcut models: `flow`, whose network also learns to take the whole way in one step.

Not in the paper. Sources: `models.shortcut`.
"""

import dataclasses
from typing import TYPE_CHECKING, Annotated

from starjax import config, errors
from starjax.learners import Learner
from starjax.limits import Range
from starjax.policies.learners import unet

if TYPE_CHECKING:  # it imports jax, which `--help` does without
    from starjax.policies.sequences import SequenceModel, Sizes

MOST_STEPS = 128  # 2 ** models.shortcut.LEVELS


@dataclasses.dataclass(frozen=True, kw_only=True)
class OnestepConfig(unet.UnetConfig):
    """Options of the learner `onestep`."""

    # network evaluations of a decision: 1, 2, 4, ...
    shortcut_steps: Annotated[int, Range(1, MOST_STEPS)] = 1


def check(options: OnestepConfig, policy_config: config.PolicyConfig) -> None:
    """Raises UsageError for the first option that does not go with another."""
    unet.check(options, policy_config)
    if options.shortcut_steps & (options.shortcut_steps - 1):
        expected = f"a power of two, at most {MOST_STEPS}"
        raise errors.UsageError("policy.shortcut_steps", expected, options.shortcut_steps)


def make(
    options: OnestepConfig, policy_config: config.PolicyConfig, sizes: "Sizes"
) -> "SequenceModel":
    """The model of these options."""
    from starjax.models import process

    return unet.make(options, policy_config, sizes, process.shortcut(options.shortcut_steps))


LEARNER = Learner(OnestepConfig, check, make)
