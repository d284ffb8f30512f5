"""Expert of peg transfer from any state: a demonstration is continued from its middle.

A held block is carried to its target. Open jaws above or about a wall come down and grip; elsewhere
a low tool rises first. A threaded block is let go. Beyond rescue: a block off the board, or
overturned.
"""

import jax
import jax.numpy as jnp

from starjax.addons.finetune.rescuers import midway, way_in
from starjax.sim.rescuer import Rescuer, entry
from starjax.sim.state import EnvState
from starjax.tasks.peg_transfer import expert, task
from starjax.tasks.phases import APPROACH, DESCEND, RAISE

GRASP = task.RIM_HEIGHT - expert.GRASP_DROP  # m, of the tip
HIGH = GRASP + expert.HOVER  # m, at which the tip goes sideways
TOLERANCE = 0.002  # m below it that counts as high, and aside that counts as above the target
ROOM = way_in.Room(
    # The pads are 2.5 mm longer than the tip.
    pads=0.0025 + task.WALL_RADIUS + expert.GRASP_DROP,
    clearance=0.0015,  # 0.2 mm less than there is
    top=expert.HOVER,
)


def rescuer(middle: float = 0.0) -> Rescuer:
    """Makes the expert; `middle` is that of `expert.init`."""

    def resume(key: jax.Array, state: EnvState) -> expert.PegScript:
        script, now = expert.init(key, state, middle), entry(state)
        tip, roll, jaws = now.p[0], now.roll[0], now.jaws[0]
        block, peg = state.measurements.block, state.layout.target_peg
        normals = task.wall_normals(block)
        off = jnp.linalg.norm(block.p + task.RIM_RADIUS * normals - tip, axis=-1)
        is_near = jnp.min(off) < expert.HELD
        is_held = now.holds[0] & is_near
        is_low = tip[2] < HIGH - TOLERANCE
        wall, side, is_coming, is_about = _way_in(state)
        script = script.replace(
            attempt=jnp.zeros((), jnp.int32),
            at=tip,
            jaws_from=jaws,
            jaws=jaws,
            wall=jnp.where(is_held, jnp.argmin(off), wall).astype(jnp.int32),
            side=side,
            # The jaws' own direction: the roll of a held block does not jump.
            normal=jnp.where(is_held, state.pose.R[0, :, 1], script.normal),
            roll_from=roll,
            roll=roll,
        )
        reach = jnp.max(normals[:, :2] @ (peg - block.p[:2]))
        is_over = reach < task.RIM_RADIUS - task.WALL_RADIUS
        over = expert._enter(script, jnp.asarray(expert.CARRY, jnp.int32), state).goal
        is_above = jnp.linalg.norm((over - tip)[:2]) < TOLERANCE
        low = jnp.where(is_over, expert.LOWER, expert.LIFT)
        held = jnp.where(is_low, low, jnp.where(is_above, expert.LOWER, expert.CARRY))
        free = jnp.where(is_coming, DESCEND, jnp.where(is_low, RAISE, APPROACH))
        phase = jnp.where(is_held, held, free)
        # Jaws that move about the wall finish that: they open about the target, else they close.
        is_moving = jnp.abs(jaws) < midway.OPEN
        phase = jnp.where(is_about & is_moving & ~is_over, expert.CLOSE, phase)
        is_done = task.is_threaded(block, peg)
        is_put = tip[2] < GRASP + expert.RELEASE_HEIGHT + midway.ARRIVED
        lets_go = is_over & is_put & is_near & jnp.where(is_held, is_done, is_moving)
        back = jnp.where(is_low & is_near, expert.RETREAT, expert.WAIT)
        phase = jnp.where(is_done & ~is_held, back, phase)
        phase = jnp.where(lets_go, expert.OPEN, phase).astype(jnp.int32)
        return midway.enter(expert._enter, expert.GRASP, script, phase, state)

    return Rescuer(resume, expert.AGENT.act, version=2)


def _way_in(state: EnvState) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Returns the grasp that the tip is nearest to, and where on the way to it the tip is.

    Returns:
      int32, the wall; the side of its middle; True on the way down with open jaws; True at the
      grasp.
    """
    now, block = entry(state), state.measurements.block
    normals = task.wall_normals(block)
    skew = jnp.abs(normals[:, 0])
    is_candidate = skew <= jnp.sort(skew)[expert.CANDIDATES - 1]
    tangents = jnp.cross(block.R[:, 2], normals)
    way = now.p[0] - block.p - task.RIM_RADIUS * normals
    along, out = (jnp.sum(way * axis, axis=-1) for axis in (tangents, normals))
    side = jnp.where(along < 0.0, -1.0, 1.0)
    off = jnp.maximum(jnp.abs(out), jnp.abs(along - side * expert.GRASP_SIDE))
    wall = jnp.argmin(jnp.where(is_candidate, off, jnp.inf))
    down = -(along[wall] - side[wall] * expert.GRASP_SIDE) * tangents[wall]
    down = down - out[wall] * normals[wall]
    down = down.at[2].set(block.p[2] - expert.GRASP_DROP - now.p[0, 2])
    return wall, side[wall], *way_in.of(ROOM, down, off[wall], normals[wall], state)


RESCUER = rescuer()
WITH_ONE_WALL = rescuer(expert.BETWEEN_ROWS)
