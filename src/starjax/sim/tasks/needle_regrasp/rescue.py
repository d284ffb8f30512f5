"""Expert of needle regrasp from any state: a needle held as for driving is lifted, else put back.

A needle that is held elsewhere or askew is let go where it is, and falls on the foam. Beyond
rescue: a needle out of the tool's reach, or too steep for its wrist.
"""

import jax
import jax.numpy as jnp

from starjax.sim.state import EnvState
from starjax.sim.tasks.needle_regrasp import expert, task
from starjax.sim.tasks.phases import APPROACH, RAISE
from starjax.sim.tasks.rescue import Rescuer, entry
from starjax.sim.tasks.wrist_script import WristScript


def resume(key: jax.Array, state: EnvState) -> WristScript:
    """Starts the script at this state."""
    script, now, found = expert.AGENT.init(key, state), entry(state), state.measurements
    is_held = now.holds[0] & task.is_as_for_driving(found)
    raised = found.pick.needle.p[2] - state.layout.needle.p[2]
    held = jnp.where(raised > task.pick.LIFT, expert.HOLD, expert.LIFT)
    is_low = now.p[0, 2] < state.layout.needle.p[2] + expert.HOVER
    phase = jnp.where(is_held, held, jnp.where(is_low, RAISE, APPROACH))
    script = script.replace(
        attempt=jnp.zeros((), jnp.int32), jaws_from=now.jaws[0], jaws=now.jaws[0]
    )
    return expert.enter(script, phase.astype(jnp.int32), state)


RESCUER = Rescuer(resume, expert.AGENT.act)
