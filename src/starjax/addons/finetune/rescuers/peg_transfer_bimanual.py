"""Expert of bimanual peg transfer from any state: the holders of the block decide the phase.

Unlike the demonstrator, it tries a missed grasp again. Beyond rescue: a dropped block.
"""

import jax
import jax.numpy as jnp

from starjax.addons.finetune.rescuers import midway
from starjax.addons.finetune.rescuers.handover_rescue import before_the_pass, enter, holders, missed
from starjax.sim.rescuer import Rescuer, entry
from starjax.sim.state import EnvState
from starjax.tasks import handover
from starjax.tasks.peg_transfer import task as single
from starjax.tasks.peg_transfer_bimanual import expert

ABOVE, LIFT, NEAR, TAKE, OPEN, AWAY, OVER, LOWER, RELEASE, RISE, WAIT = map(
    expert.PHASES.index,
    (
        "above", "lift", "near", "take", "open", "away", "over", "lower", "release", "rise", "wait",
    ),
)  # fmt: skip
TOLERANCE = 0.002  # m from its place above the target, at which the taker comes down
BESIDE = 0.02  # m of a tip from the nearest wall, beyond which it has left it


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
    block, (gives, takes) = state.measurements.block, holders(now)
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
    is_up = _is_up(state)
    is_low = now.p[0, 2] < single.RIM_HEIGHT + expert.HOVER - expert.GRASP_DROP
    script = script.replace(held=held)
    alone = before_the_pass(PLAY, expert.PHASES, script, state, is_up, is_low)
    reach = jnp.max(normals[:, :2] @ (state.layout.target_peg - block.p[:2]))
    is_over = reach < single.RIM_RADIUS - single.WALL_RADIUS
    is_close = jnp.linalg.norm(walls - now.p[:, None], axis=-1).min(axis=-1) < BESIDE
    goals, _ = PLAY.goals(script.replace(p=now.p), state)
    off = now.p[1] - goals[OVER, 1]
    has_come = (jnp.linalg.norm(off[:2]) < TOLERANCE) | (off[2] < -TOLERANCE)
    is_over = is_over & has_come
    onward = jnp.where(is_close[0], AWAY, jnp.where(is_over, LOWER, OVER))
    opens = gives | (is_close[0] & (now.jaws[0] < midway.OPEN))
    phase = jnp.where(takes, jnp.where(opens, OPEN, onward), alone)
    # A threaded block is let go.
    is_open = now.jaws[1] > midway.OPEN
    left = jnp.where(is_close[1], jnp.where(is_open, RISE, RELEASE), WAIT)
    is_done = single.is_threaded(block, state.layout.target_peg) & ~gives & ~takes
    return enter(PLAY, script, jnp.where(is_done, left, phase), held, state)


def nearly_lost(state: EnvState) -> jax.Array:
    """Returns True if the taker has closed without the wall: the giver will let go next."""
    return missed(state) & _is_up(state)


def _is_up(state: EnvState) -> jax.Array:
    return state.measurements.block.p[2] > single.RIM_HEIGHT + single.LIFTED


RESCUER = Rescuer(resume, handover.agent(PLAY).act, nearly_lost, version=2)
