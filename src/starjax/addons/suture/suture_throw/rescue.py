"""Expert of suture throw from any state: the throw is carried on from where the needle is.

Beyond rescue: a dropped needle; one that has entered or left the pad off a mark, or pushed too
hard; a collision.
"""

import jax
import jax.numpy as jnp

from starjax.addons.suture.suture_throw import expert, far_grasp, task
from starjax.addons.suture.tissue import needle as needles
from starjax.sim import ik
from starjax.sim.rescuer import Rescuer, entry
from starjax.sim.state import EnvState

LOW = 0.035  # m, of the tip: below it the jaws open and go back before anything else
NEAR = 0.025  # m from tip to needle: as LOW
EARLY = 0.1  # rad before the middle of the turn out from which the second grasp serves, too
ASKEW = 0.5  # rad between a grasp of the point and the expert's, beyond which it is taken again


def resume(key: jax.Array, state: EnvState) -> expert.ThrowScript:
    """Starts the script at this state."""
    script, now, found = expert.AGENT.init(key, state), entry(state), state.measurements
    drive, bite = found.drive, state.layout.bite
    _, middle, _ = expert.turns(bite)
    turn = task.turn_out(needles.turn_on(task.SIZE, bite, drive.needle))
    is_out = drive.emerged >= expert.OUT_ENOUGH
    is_late = is_out & (turn > middle - EARLY)
    # Held by the point: turned out, or let go after the first grasp's way or from an odd one.
    held = expert.held(state).R
    off = jax.vmap(lambda R: ik.rotation_between(R, held))(far_grasp.grasps(task.SIZE).R)
    off = jnp.linalg.norm(off, axis=-1)
    by_second = off[1] < off[0]
    turns_on = found.by_point & (jnp.min(off) < ASKEW) & (by_second | ~is_late)
    leg = jnp.where(turns_on, by_second, is_late)
    by_point = jnp.where(turns_on, expert.OUT, expert.OPEN)
    inside = jnp.where(is_out, by_point, expert.DRIVE)
    is_low = now.p[0, 2] < LOW
    picked = jnp.where(is_low, expert.LIFT, expert.OVER)
    taken = jnp.where(drive.is_inside, inside, jnp.where(found.is_through, expert.PULL, picked))
    # Let go: back first, if anything is near.
    is_close = is_low | (jnp.linalg.norm(now.p[0] - drive.needle.p) < NEAR)
    free = jnp.where(drive.is_inside & is_out, expert.AROUND, expert.APPROACH)
    free = jnp.where(is_close, expert.BACK, free)
    phase = jnp.where(drive.held, taken, free).astype(jnp.int32)
    script = script.replace(
        attempt=jnp.zeros((), jnp.int32),
        jaws_from=now.jaws[0],
        jaws=now.jaws[0],
        leg=leg.astype(jnp.int32),
    )
    return expert.enter(script, phase, state)


RESCUER = Rescuer(resume, expert.AGENT.act, version=2)
