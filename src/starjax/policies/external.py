"""Policies of other packages instead of sequence models of starjax, by name. Imports no jax.

An entry point of the group `starjax.policies` names an `ExternalPolicy`: any program that turns an
observation into commands, such as a vision-language-action model or a scripted controller.
"""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

from starjax.core.registry import Registry


class ExternalPolicy(NamedTuple):
    """A policy and the observation that it takes.

    Attributes:
      description: a line for people.
      task: name of the task that it acts in.
      make: () -> object with `act(observation) -> actions`. The observation has openpi's names:
        `observation/state` `[8 A]` of each arm's tip (x y z in m, quaternion x y z w) and gripper
        from -1 closed to 1 open, `observation/trocar` `[3 A]` m, `prompt`, and
        `observation/image` `[h, w, 3]` uint8 or `observation/environment_state`. The actions are
        `[H, 8 A]` in the form of the state, the same H at every call.
      observation: `image` or `state`.
      image_size: pixels per side.
      arms, tools, cameras: names; empty for the task's defaults.
      execute: commands executed before the next plan; 0 for all.
      version: raised with a change of its commands.
    """

    description: str
    task: str
    make: Callable[[], Any]
    observation: Literal["image", "state"] = "image"
    image_size: int = 224
    arms: tuple[str, ...] = ()
    tools: tuple[str, ...] = ()
    cameras: tuple[str, ...] = ()
    execute: int = 0
    version: int = 1


POLICIES = Registry("policy", {}, "starjax.policies.external:ExternalPolicy")
