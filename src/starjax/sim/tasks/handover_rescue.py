"""Entry of a scripted hand-over into an episode that another agent began."""

from typing import Any

import jax
import jax.numpy as jnp

from starjax.sim.state import EnvState
from starjax.sim.tasks import handover
from starjax.sim.tasks.rescue import entry


def enter(
    play: handover.Play,
    script: handover.HandoverScript,
    phase: jax.Array,
    held: Any,
    state: EnvState,
) -> handover.HandoverScript:
    """Returns the script at the start of `phase`, with the tools as they are.

    Args:
      play: of the script.
      script: from the expert's `init` at this state.
      phase: int32.
      held: the task's own, the held part of the object.
      state: at the entry.
    """
    now = entry(state)
    # Jaws that hold keep their direction; others turn back to the demonstrated roll.
    normal = jnp.where(now.holds[:, None], state.pose.R[:, :, 1], script.normal)
    script = script.replace(
        held=held, p=now.p, roll=now.roll, jaws=now.jaws, jaws_from=now.jaws, normal=normal
    )
    return handover._enter(play, script, phase.astype(jnp.int32), state)
