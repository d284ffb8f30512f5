"""Expert of needle pick from any state: a held needle is lifted or held on, else taken up anew.

Beyond rescue: a needle out of the tool's reach.
"""

import jax
import jax.numpy as jnp

from starjax.sim.state import EnvState
from starjax.sim.tasks.needle_pick import expert, task
from starjax.sim.tasks.phases import APPROACH, RAISE
from starjax.sim.tasks.rescue import Rescuer, entry


def resume(key: jax.Array, state: EnvState) -> expert.NeedleScript:
    """Starts the script at this state."""
    script, now, found = expert.init(key, state), entry(state), state.measurements
    # A grasp of the point never succeeds.
    is_held = now.holds[0] & ~found.sticks
    is_up = found.needle.p[2] > state.layout.needle.p[2] + task.LIFT
    is_low = now.p[0, 2] < expert.HOVER
    held = jnp.where(is_up, expert.HOLD, expert.LIFT)
    phase = jnp.where(is_held, held, jnp.where(is_low, RAISE, APPROACH))
    script = script.replace(
        attempt=jnp.zeros((), jnp.int32),
        at=now.p[0],
        jaws_from=now.jaws[0],
        jaws=now.jaws[0],
        # The jaws' own direction: the roll of a held needle does not jump.
        normal=jnp.where(is_held, state.pose.R[0, :, 1], script.normal),
        roll_from=now.roll[0],
        roll=now.roll[0],
    )
    return expert._enter(script, phase.astype(jnp.int32), state)


RESCUER = Rescuer(resume, expert.AGENT.act)
