"""Expert of reach from any state: it turns back to the demonstrated roll on the way."""

import flax.struct
import jax
import jax.numpy as jnp

from starjax.core.types import Command
from starjax.sim.rescuer import Rescuer, entry
from starjax.sim.state import EnvState
from starjax.tasks import scripting
from starjax.tasks.reach import expert


@flax.struct.dataclass
class TurningScript:
    """Script of one episode.

    Attributes:
      reach: of the expert.
      roll: `[1]` rad at the start.
    """

    reach: expert.ReachScript
    roll: jax.Array


def resume(key: jax.Array, state: EnvState) -> TurningScript:
    """Starts the script at this state."""
    return TurningScript(expert.init(key, state), entry(state).roll)


def act(script: TurningScript, state: EnvState) -> tuple[Command, TurningScript, Command]:
    """Returns the expert's commands with the rest of the roll."""
    rough, reach, label = expert.act(script.reach, state)
    left = 1.0 - scripting.sloped(jnp.clip(reach.elapsed / reach.duration, 0.0, 1.0))
    rough, label = (
        scripting.command(left * script.roll, way.pose.p, way.gripper, state)
        for way in (rough, label)
    )
    return rough, script.replace(reach=reach), label


RESCUER = Rescuer(resume, act, version=2)
