"""Expert of needle drive from any state: a needle in the pad is driven on, else taken to its entry.

Beyond rescue: a dropped needle, and one that has left the pad off the mark.
"""

from typing import Any

import jax
import jax.numpy as jnp

from starjax.addons.suture.needle_drive import dial, expert, task
from starjax.addons.suture.tissue import needle as needles
from starjax.addons.suture.tissue.needle import Needle
from starjax.core.types import Agent
from starjax.sim.rescuer import Rescuer
from starjax.sim.state import EnvState
from starjax.tasks.phases import APPROACH, RAISE

LOW = 0.025  # m, of the tip: below it a needle that turns could touch the pad


def make(size: Needle, agent: Agent, plane: expert.Plane = expert.vertical) -> Rescuer:
    """Makes the rescuer for a needle and its demonstrator, which drives in a plane."""

    def resume(key: jax.Array, state: EnvState) -> Any:
        """Starts the script at this state."""
        script, found = agent.init(key, state), state.measurements
        is_out = found.emerged > task.EMERGED
        driven = jnp.where(is_out, expert.HOLD, expert.DRIVE)
        above = jnp.where(found.tip[2] < LOW, RAISE, APPROACH)
        phase = jnp.where(found.is_inside, driven, above)
        script = script.replace(attempt=jnp.zeros((), jnp.int32))
        return expert.enter(size, script, phase.astype(jnp.int32), state, plane)

    return Rescuer(resume, agent.act, version=2)


RESCUER = make(needles.CT1, expert.AGENT)
SMALL = make(needles.SH, expert.SMALL)
DIAL = make(dial.SIZE, dial.AGENT, dial.plane)
DIAL_ONE_PLANE = make(dial.SIZE, dial.ONE_PLANE, dial.one_plane)
