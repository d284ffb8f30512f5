"""Expert of needle hand-over from any state: holders and tips decide the phase.

Beyond rescue: a dropped needle, or one that the taker took before the giver had lifted it.
"""

import jax
import jax.numpy as jnp

from starjax.sim.state import EnvState
from starjax.sim.tasks.handover_rescue import enter
from starjax.sim.tasks.needle_handover import expert
from starjax.sim.tasks.needle_pick import task as single
from starjax.sim.tasks.rescue import Rescuer, entry

ABOVE, LIFT, CARRY, NEAR, MEET, OPEN, AWAY, HOLD = map(
    expert.PHASES.index, ("above", "lift", "carry", "near", "meet", "open", "away", "hold")
)
_HELD, _CLOSE = 100, 10  # weights of a segment against the drawn one: held, next to the taker
_MET = 0.006  # m, distance of the giver's segment from the meeting point, at which the taker comes
_REACH = 0.03  # m of the taker's tip from its segment, just beyond the start of its way in
_EMPTY = -0.65  # measured opening: about -0.5 for jaws on the wire, -0.8 for closed jaws without it


def resume(key: jax.Array, state: EnvState) -> expert.handover.HandoverScript:
    """Starts the script at this state."""
    script, now = expert.AGENT.init(key, state), entry(state)
    needle, (gives, takes) = state.measurements.needle, now.holds
    wire = needle.p + jnp.asarray(expert.MIDDLES) @ needle.R.T
    off = jnp.linalg.norm(wire - now.p[:, None], axis=-1)
    nearest = jnp.argmin(off, axis=-1)
    is_close = off.min(axis=-1) < expert.HOVER
    pairs = jnp.asarray(expert.PAIRS)
    weight = jnp.where(now.holds, _HELD, jnp.where(is_close, jnp.array([0, _CLOSE]), 0))
    cost = weight * jnp.abs(pairs - nearest) + jnp.abs(pairs - script.held)
    held = pairs[jnp.argmin(cost.sum(-1))]
    is_up = _is_up(state)
    is_low = now.p[0, 2] < needle.p[2] + expert.HOVER
    # The taker continues from its place: back to its park it would teach little of the grasp.
    is_met = jnp.linalg.norm(wire[held[0]] - jnp.array(expert.MEET)) < _MET
    above = now.p[1] - wire[held[1]]
    is_coming = (jnp.linalg.norm(above[:2]) < above[2]) & (jnp.linalg.norm(above) < _REACH)
    meets = jnp.where(is_coming & (now.jaws[1] > 0.0), MEET, NEAR)
    # A low giver closes and rises; with empty jaws it starts over from there.
    lifted = jnp.where(is_met, meets, CARRY)
    alone = jnp.where(gives & is_up, lifted, jnp.where(gives | is_low, LIFT, ABOVE))
    taken = jnp.where(gives, OPEN, jnp.where(is_close[0], AWAY, HOLD))
    return enter(expert.PLAY, script, jnp.where(takes, taken, alone), held, state)


def nearly_lost(state: EnvState) -> jax.Array:
    """Returns True if the taker has closed without the wire: the giver will let go next."""
    gives, takes = state.touch
    has_closed = (state.gripper_target[1] < 0.0) & (state.gripper[1] < _EMPTY)
    return gives & ~takes & has_closed & _is_up(state)


def _is_up(state: EnvState) -> jax.Array:
    return state.measurements.needle.p[2] > state.layout.needle.p[2] + single.LIFT


RESCUER = Rescuer(resume, expert.AGENT.act, nearly_lost)
