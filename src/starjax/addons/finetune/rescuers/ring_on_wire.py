"""Expert of ring on wire from any state: a held ring is lifted and carried on, else taken up.

Beyond rescue: a ring that has touched the wire too often.
"""

import jax
import jax.numpy as jnp

from starjax.sim.rescuer import Rescuer, entry
from starjax.sim.state import EnvState
from starjax.tasks.phases import APPROACH, RAISE
from starjax.tasks.ring_on_wire import expert, task

NEARLY = 0.5  # fraction of the touches that a success may have
HIGH = task.TIP_HOME[2] - task.TIP_SPREAD  # m, the lowest start, from which it approaches
TOLERANCE = 1e-4  # m below it


def resume(key: jax.Array, state: EnvState) -> expert.RingScript:
    """Starts the script at this state."""
    script, now = expert.init(key, state), entry(state)
    is_low = now.p[0, 2] < HIGH - TOLERANCE
    phase = jnp.where(now.holds[0], expert.LIFT, jnp.where(is_low, RAISE, APPROACH))
    script = script.replace(
        attempt=jnp.zeros((), jnp.int32),
        at=jnp.append(now.roll[0], now.p[0]),
        jaws_from=now.jaws[0],
        jaws=now.jaws[0],
    )
    return expert._enter(script, phase.astype(jnp.int32), state)


def nearly_lost(state: EnvState) -> jax.Array:
    """Returns True once the ring has touched the wire half as often as it may."""
    return state.measurements.rubbed > NEARLY * task.MAY_TOUCH


RESCUER = Rescuer(resume, expert.AGENT.act, nearly_lost, version=2)
