"""Needle hand-over with experts that rest each time their jaws have moved."""

import functools

import flax.struct
import jax
import jax.numpy as jnp

from starjax.core.types import Agent, Command
from starjax.sim.state import EnvState
from starjax.sim.task import CONTROL_HZ
from starjax.tasks import handover, scripting
from starjax.tasks.needle_handover import expert
from starjax.tasks.needle_handover.task import TASK as PLAIN

RESTS = (0.0, 0.1, 0.3, 0.6)  # s


@flax.struct.dataclass
class Rest:
    """A script and its rest.

    Attributes:
      script: of the expert.
      executed, recorded: commands of the last step.
      steps: int32, control steps of the present rest.
    """

    script: handover.HandoverScript
    executed: Command
    recorded: Command
    steps: jax.Array


def resting(rest: float) -> Agent:
    """Makes the expert that repeats its command for `rest` s after each phase of jaws."""
    agent, count = expert.AGENT, round(rest * CONTROL_HZ)
    is_of_jaws = jnp.asarray(scripting.is_of_jaws(expert.PLAY.jaws))

    def init(key: jax.Array, state: EnvState) -> Rest:
        script = agent.init(key, state)
        executed, _, recorded = agent.act(script, state)
        return Rest(script, executed, recorded, jnp.zeros((), jnp.int32))

    def act(memory: Rest, state: EnvState) -> tuple[Command, Rest, Command]:
        executed, script, recorded = agent.act(memory.script, state)
        is_over = is_of_jaws[memory.script.phase] & (script.phase != memory.script.phase)
        rests = is_over & (memory.steps < count)
        moving = Rest(script, executed, recorded, jnp.zeros((), jnp.int32))
        still = memory.replace(steps=memory.steps + 1)
        after = jax.tree.map(lambda a, b: jnp.where(rests, a, b), still, moving)
        return after.executed, after, after.recorded

    return Agent(init, act)


TASK = PLAIN._replace(
    name="needle_handover_pauses",
    experts={f"rest_{rest}": functools.partial(resting, rest) for rest in RESTS},
)
