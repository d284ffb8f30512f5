"""Expert of bimanual peg transfer from any state: the holders of the block decide the phase.

Unlike the demonstrator, it tries a missed grasp again. Beyond rescue: a dropped block.
"""

import jax
import jax.numpy as jnp

from starjax.sim.state import EnvState
from starjax.sim.tasks import handover
from starjax.sim.tasks.handover_rescue import enter
from starjax.sim.tasks.peg_transfer import task as single
from starjax.sim.tasks.peg_transfer_bimanual import expert
from starjax.sim.tasks.rescue import Rescuer, entry

ABOVE, LIFT, CARRY, NEAR, TAKE, OPEN, OVER, LOWER = map(
    expert.PHASES.index, ("above", "lift", "carry", "near", "take", "open", "over", "lower")
)


def _following(script: handover.HandoverScript, state: EnvState) -> jax.Array:
    """Returns the next phase, an earlier one if a tool missed the wall."""
    following = expert.PLAY.following(script, state)
    touch = state.measurements.touch
    following = jnp.where((script.phase == LIFT) & ~touch[0], ABOVE, following)
    return jnp.where((script.phase == TAKE) & ~touch[1], NEAR, following).astype(jnp.int32)


PLAY = expert.PLAY._replace(following=_following)


def resume(key: jax.Array, state: EnvState) -> handover.HandoverScript:
    """Starts the script at this state."""
    script, now = expert.AGENT.init(key, state), entry(state)
    block, (gives, takes) = state.measurements.block, now.holds
    normals = single.wall_normals(block)
    walls = block.p + single.RIM_RADIUS * normals
    tip = jnp.where(gives, now.p[0], now.p[1])
    out = normals[jnp.argmin(jnp.linalg.norm(walls - tip, axis=-1))]
    along = jnp.cross(block.R[:, 2], out)
    along = along * jnp.where(along[0] < 0, -1.0, 1.0)
    drawn_out, drawn_along = script.held
    is_held = gives | takes
    held = (
        jnp.where(is_held, block.R.T @ out, drawn_out),
        jnp.where(is_held, block.R.T @ along, drawn_along),
    )
    is_up = block.p[2] > single.RIM_HEIGHT + single.LIFTED
    is_low = now.p[0, 2] < single.RIM_HEIGHT + expert.HOVER - expert.GRASP_DROP
    # A low giver closes and rises; with empty jaws it starts over from there.
    alone = jnp.where(gives & is_up, CARRY, jnp.where(gives | is_low, LIFT, ABOVE))
    reach = jnp.max(normals[:, :2] @ (state.layout.target_peg - block.p[:2]))
    is_over = reach < single.RIM_RADIUS - single.WALL_RADIUS
    taken = jnp.where(gives, OPEN, jnp.where(is_over, LOWER, OVER))
    return enter(PLAY, script, jnp.where(takes, taken, alone), held, state)


RESCUER = Rescuer(resume, handover.agent(PLAY).act)
