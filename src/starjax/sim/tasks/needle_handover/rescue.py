"""Expert of needle hand-over from any state: the holders of the needle decide the phase.

Beyond rescue: a dropped needle, or one that the taker took before the giver had lifted it.
"""

import jax
import jax.numpy as jnp

from starjax.sim.state import EnvState
from starjax.sim.tasks.handover_rescue import enter
from starjax.sim.tasks.needle_handover import expert
from starjax.sim.tasks.needle_pick import task as single
from starjax.sim.tasks.rescue import Rescuer, entry

ABOVE, LIFT, CARRY, OPEN, AWAY = map(
    expert.PHASES.index, ("above", "lift", "carry", "open", "away")
)
_HELD = 100  # weight of a held segment against the drawn one


def resume(key: jax.Array, state: EnvState) -> expert.handover.HandoverScript:
    """Starts the script at this state."""
    script, now = expert.AGENT.init(key, state), entry(state)
    needle, (gives, takes) = state.measurements.needle, now.holds
    wire = needle.p + jnp.asarray(expert.MIDDLES) @ needle.R.T
    off = jnp.linalg.norm(wire - now.p[:, None], axis=-1)
    nearest = jnp.argmin(off, axis=-1)
    pairs = jnp.asarray(expert.PAIRS)
    weight = jnp.where(now.holds, _HELD, 0)
    cost = weight * jnp.abs(pairs - nearest) + jnp.abs(pairs - script.held)
    held = pairs[jnp.argmin(cost.sum(-1))]
    is_up = needle.p[2] > state.layout.needle.p[2] + single.LIFT
    is_low = now.p[0, 2] < needle.p[2] + expert.HOVER
    # A low giver closes and rises; with empty jaws it starts over from there.
    alone = jnp.where(gives & is_up, CARRY, jnp.where(gives | is_low, LIFT, ABOVE))
    phase = jnp.where(takes, jnp.where(gives, OPEN, AWAY), alone)
    return enter(expert.PLAY, script, phase, held, state)


RESCUER = Rescuer(resume, expert.AGENT.act)
