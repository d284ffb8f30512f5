"""Experts that finish an episode which another agent began.

Apart from the experts' own modules, whose digests name demonstrations: an edit here leaves those
valid.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from starjax import rcm
from starjax.sim.state import EnvState


def _never(state: EnvState) -> jax.Array:
    return jnp.zeros((), bool)


class Rescuer(NamedTuple):
    """Scripted expert that starts from any state of a task, as pure functions of one episode.

    Attributes:
      resume: (key, EnvState) -> memory. At reset it acts like the expert.
      act: as `Agent.act`, of the expert.
      nearly_lost: EnvState -> bool, True if the task will soon be lost unless something changes.
      version: raised with a change of its motions.
    """

    resume: Callable[[jax.Array, EnvState], Any]
    act: Callable[..., Any]
    nearly_lost: Callable[[EnvState], jax.Array] = _never
    version: int = 1


class Entry(NamedTuple):
    """Tools at the moment of an entry.

    Attributes:
      p: `[A, 3]` m, measured tips.
      roll: `[A]` rad in [-pi, pi), measured, from the slots' zero.
      jaws: `[A]`, commanded openings.
      holds: `[A]` bool, True for jaws that touch something graspable and are commanded to close.
    """

    p: jax.Array
    roll: jax.Array
    jaws: jax.Array
    holds: jax.Array


def entry(state: EnvState) -> Entry:
    """Returns the tools at this moment."""
    roll = rcm.roll_of(state.pose.R) - state.measured_trocar.roll_zero
    roll = (roll + jnp.pi) % (2.0 * jnp.pi) - jnp.pi
    holds = state.touch & (state.gripper_target < 0.0)
    return Entry(state.pose.p, roll, state.gripper_target, holds)
