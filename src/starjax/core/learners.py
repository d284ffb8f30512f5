"""Learners of action sequences by name. `--help` reads this module, which imports no jax.

A method (`methods`) defines the action space, the conditioning and whether a separate network
predicts the roll; every method works with every learner. Others add theirs by an entry point
of the group `starjax.learners` that names a `Learner`, and trunks of image encoders by one of the
group `starjax.encoders` that names a `models.encoders.Trunk`.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

from starjax.core import methods, sources
from starjax.core.registry import Registry


class Learner(NamedTuple):
    """One way to learn sequences of actions and to generate them.

    Attributes:
      settings: frozen dataclass of its own options, all with defaults, none of them called as a
        field of `config.PolicyConfig` is. They are flags like those of the policy.
      check: (options, PolicyConfig) -> None; raises UsageError for options that do not go together
        or with the policy's. It imports no jax.
      make: (options, PolicyConfig, policies.sequences.Sizes) -> policies.sequences.SequenceModel.
      version: raised with a change of its loss or samples; a training continues under an equal one.
    """

    settings: type
    check: Callable[[Any, Any], None]
    make: Callable[[Any, Any, Any], Any]
    version: int = 1


LEARNERS = Registry(
    "learner",
    {
        "diffusion": "starjax.policies.learners.diffusion:LEARNER",
        "flow": "starjax.policies.learners.flow:LEARNER",
        "onestep": "starjax.policies.learners.onestep:LEARNER",
        "act": "starjax.policies.learners.act:LEARNER",
        "bc": "starjax.policies.learners.bc:LEARNER",
    },
    "starjax.core.learners:Learner",
)
ENCODERS = Registry(
    "encoder",
    {
        "resnet18": "starjax.policies.models.encoders:RESNET18",
        "small": "starjax.policies.models.encoders:SMALL",
        "points": "starjax.policies.point_encoder:POINTS",
    },
    "starjax.policies.models.encoders:Trunk",
)


def parts(method: str, learner: str, *encoders: str) -> list[sources.Identity]:
    """Returns the identity of each part of a policy.

    Empty names of encoders are those that it lacks.
    """
    used = [sources.identity(ENCODERS, name) for name in encoders if name]
    return [sources.identity(LEARNERS, learner), *used, *methods.parts(method)]
