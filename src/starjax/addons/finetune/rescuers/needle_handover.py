"""Expert of needle hand-over from any state: holders and tips decide the phase.

Beyond rescue: a dropped needle, or one that the taker took before the giver had lifted it.
"""

import jax
import jax.numpy as jnp

from starjax.addons.finetune.rescuers import midway, way_in
from starjax.addons.finetune.rescuers.handover_rescue import before_the_pass, enter, holders, missed
from starjax.sim.rescuer import Rescuer, entry
from starjax.sim.state import EnvState
from starjax.tasks.needle_handover import expert
from starjax.tasks.needle_pick import task as single

OPEN, AWAY, RAISE = map(expert.PHASES.index, ("open", "away", "raise"))
LEFT = 0.028  # m of a giver from the wire, at which it has left it, on its way or not
GONE = 0.012  # m of a giver at rest from the wire, beyond which it has gone
_HELD, _CLOSE = 100, 10  # weights of a segment against the drawn one: held, at a tool
_AT = 0.006  # m from a tip to the wire: further out it may be on its way to the drawn one


def resume(key: jax.Array, state: EnvState) -> expert.handover.HandoverScript:
    """Starts the script at this state."""
    script, now = expert.AGENT.init(key, state), entry(state)
    needle, (gives, takes) = state.measurements.needle, holders(now)
    wire = needle.p + jnp.asarray(expert.MIDDLES) @ needle.R.T
    off = jnp.linalg.norm(wire - now.p[:, None], axis=-1)
    nearest = jnp.argmin(off, axis=-1)
    is_close = off.min(axis=-1) < expert.HOVER
    pairs = jnp.asarray(expert.PAIRS)
    weight = jnp.where(now.holds, _HELD, jnp.where(off.min(axis=-1) < _AT, _CLOSE, 0))
    cost = weight * jnp.abs(pairs - nearest) + jnp.abs(pairs - script.held)
    held = pairs[jnp.argmin(cost.sum(-1))]
    is_low = now.p[0, 2] < needle.p[2] + expert.HOVER
    script = script.replace(held=held)
    alone = before_the_pass(expert.PLAY, expert.PHASES, script, state, _is_up(state), is_low)
    opens = gives | (is_close[0] & (now.jaws[0] < midway.OPEN))
    speed = jnp.linalg.norm(state.velocity[0, :3])
    is_going = (off[0].min() < LEFT) & ((off[0].min() < GONE) | (speed > way_in.SLOW))
    taken = jnp.where(opens, OPEN, jnp.where(is_going, AWAY, RAISE))
    return enter(expert.PLAY, script, jnp.where(takes, taken, alone), held, state)


def nearly_lost(state: EnvState) -> jax.Array:
    """Returns True if the taker has closed without the wire: the giver will let go next."""
    return missed(state) & _is_up(state)


def _is_up(state: EnvState) -> jax.Array:
    return state.measurements.needle.p[2] > state.layout.needle.p[2] + single.LIFT


RESCUER = Rescuer(resume, expert.AGENT.act, nearly_lost, version=2)
