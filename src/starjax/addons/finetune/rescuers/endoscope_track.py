"""Expert of endoscope tracking from any state: it begins at the roll of the scope.

Beyond rescue: a target that was missed for too long.
"""

import jax
import jax.numpy as jnp

from starjax.sim.rescuer import Rescuer, entry
from starjax.sim.state import EnvState
from starjax.tasks.endoscope_track import expert, task

NEARLY = 0.6  # fraction of the steps that a success may miss


def resume(key: jax.Array, state: EnvState) -> expert.TrackScript:
    """Starts the script at this state."""
    now, goal = entry(state), expert._target(task.DISTANCE, state)[0]
    roll = goal + (now.roll[0] - goal + jnp.pi) % (2.0 * jnp.pi) - jnp.pi  # the shorter turn
    return expert.init(key, state).replace(start=jnp.append(roll, now.p[0]))


def nearly_lost(state: EnvState) -> jax.Array:
    """Returns True once the target was missed for more than `NEARLY` of the allowed steps."""
    return state.measurements.missed > NEARLY * task.MAY_MISS


RESCUER = Rescuer(resume, expert.AGENT.act, nearly_lost, version=2)
