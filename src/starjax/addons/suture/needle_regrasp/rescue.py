"""Expert of needle regrasp from any state: a needle held as for driving is lifted, else put back.

A needle that is held elsewhere or askew is let go where it is, and falls on the foam; one that has
fallen from the plate is lifted higher. Beyond rescue: a needle out of the tool's reach, too steep
for its wrist, pressed into the plate, or rolling on its edge, which nothing stops.
"""

from typing import Any

import jax
import jax.numpy as jnp

from starjax.addons.suture.needle_regrasp import expert, task
from starjax.core.types import Command
from starjax.sim.rescuer import Rescuer, entry
from starjax.sim.state import EnvState
from starjax.tasks.phases import APPROACH, RAISE
from starjax.tasks.wrist_script import WristScript

HIGH_ENOUGH = task.pick.LIFT + 0.003  # m from the needle's rest to the lifted tip, the least


def resume(key: jax.Array, state: EnvState) -> WristScript:
    """Starts the script at this state."""
    script, now, found = expert.AGENT.init(key, state), entry(state), state.measurements
    is_held = now.holds[0] & task.is_as_for_driving(found)
    raised = found.pick.needle.p[2] - state.layout.needle.p[2]
    held = jnp.where(raised > task.pick.LIFT, expert.HOLD, expert.LIFT)
    is_low = now.p[0, 2] < state.layout.needle.p[2] + expert.HOVER
    phase = jnp.where(is_held, held, jnp.where(is_low, RAISE, APPROACH))
    script = script.replace(
        attempt=jnp.zeros((), jnp.int32), jaws_from=now.jaws[0], jaws=now.jaws[0]
    )
    return expert.enter(script, phase.astype(jnp.int32), state)


def act(script: WristScript, state: EnvState) -> tuple[Command, Any, Command]:
    """Does as the expert, which looks neither at the grasp nor at the height that it lifts from."""
    found = state.measurements
    holds = (script.phase == expert.HOLD) & found.pick.touch
    is_wrong = holds & ~task.is_as_for_driving(found)
    again = expert.enter(script, jnp.asarray(RAISE, jnp.int32), state)
    script = jax.tree.map(lambda a, b: jnp.where(is_wrong, a, b), again, script)
    high = script.goal.at[2].max(state.layout.needle.p[2] + HIGH_ENOUGH)
    script = script.replace(goal=jnp.where(script.phase == expert.LIFT, high, script.goal))
    return expert.AGENT.act(script, state)


RESCUER = Rescuer(resume, act, version=2)
