"""Expert of peg transfer from any state: a held block is carried on, any other is taken up.

Beyond rescue: a block off the board, or overturned.
"""

import jax
import jax.numpy as jnp

from starjax.sim.state import EnvState
from starjax.sim.tasks.peg_transfer import expert, task
from starjax.sim.tasks.phases import APPROACH, RAISE
from starjax.sim.tasks.rescue import Rescuer, entry

HIGH = task.RIM_HEIGHT - expert.GRASP_DROP + expert.HOVER  # m, at which the tip goes sideways
TOLERANCE = 0.002  # m below it that counts as high


def rescuer(middle: float = 0.0) -> Rescuer:
    """Makes the expert; `middle` is that of `expert.init`."""

    def resume(key: jax.Array, state: EnvState) -> expert.PegScript:
        script, now = expert.init(key, state, middle), entry(state)
        tip, roll, jaws = now.p[0], now.roll[0], now.jaws[0]
        block, peg = state.measurements.block, state.layout.target_peg
        normals = task.wall_normals(block)
        off = jnp.linalg.norm(block.p + task.RIM_RADIUS * normals - tip, axis=-1)
        is_held = now.holds[0] & (jnp.min(off) < expert.HELD)
        is_low = tip[2] < HIGH - TOLERANCE
        reach = jnp.max(normals[:, :2] @ (peg - block.p[:2]))
        is_over = reach < task.RIM_RADIUS - task.WALL_RADIUS
        low = jnp.where(is_over, expert.LOWER, expert.LIFT)
        held = jnp.where(is_low, low, expert.CARRY)
        phase = jnp.where(is_held, held, jnp.where(is_low, RAISE, APPROACH))
        script = script.replace(
            attempt=jnp.zeros((), jnp.int32),
            at=tip,
            jaws_from=jaws,
            jaws=jaws,
            wall=jnp.where(is_held, jnp.argmin(off), script.wall).astype(jnp.int32),
            # The jaws' own direction: the roll of a held block does not jump.
            normal=jnp.where(is_held, state.pose.R[0, :, 1], script.normal),
            roll_from=roll,
            roll=roll,
        )
        return expert._enter(script, phase.astype(jnp.int32), state)

    return Rescuer(resume, expert.AGENT.act)


RESCUER = rescuer()
WITH_ONE_WALL = rescuer(expert.BETWEEN_ROWS)
