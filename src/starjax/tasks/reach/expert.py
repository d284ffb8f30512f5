"""Scripted expert of reach: along an arc to the mark, to one side or the other, and rest.

The side is drawn, never by the trocar; so is the pace. It is disturbed on purpose and comes back.
"""

import flax.struct
import jax
import jax.numpy as jnp

from starjax.core.types import Agent, Command
from starjax.sim.state import EnvState
from starjax.sim.task import CONTROL_HZ
from starjax.tasks import scripting

SPEED = 0.04  # m/s, mean along the straight line
LEAST_TIME = 0.7  # s
TEMPO = (0.85, 1.2)  # range of an episode's pace
BULGE = 0.25  # the arc's largest offset from the line, as a fraction of its length
DEVIATION = 0.0012  # m, of the disturbance
CALM = 0.8  # fraction of the way after which the disturbance has faded


@flax.struct.dataclass
class ReachScript:
    """Script of one episode.

    Attributes:
      key: of all draws.
      start: `[3]` m.
      side: `[3]` m, the arc's largest offset from the line.
      duration, elapsed: s.
      noise: `[2, 3]` m, disturbance, rough and smooth.
    """

    key: jax.Array
    start: jax.Array
    side: jax.Array
    duration: jax.Array
    elapsed: jax.Array
    noise: jax.Array


def init(key: jax.Array, state: EnvState) -> ReachScript:
    """Draws side and pace."""
    key, key_side, key_tempo = jax.random.split(key, 3)
    start, goal = state.pose.p[0], state.layout.p
    way = goal - start
    length = jnp.linalg.norm(way)
    across = jnp.cross(way, jnp.array([0.0, 0.0, 1.0]))
    across = across / jnp.maximum(jnp.linalg.norm(across), 1e-6)  # zero for a vertical way
    side = jax.random.rademacher(key_side, (), jnp.float32) * BULGE * length * across
    tempo = jax.random.uniform(key_tempo, minval=TEMPO[0], maxval=TEMPO[1])
    duration = jnp.maximum(length / SPEED, LEAST_TIME) / tempo
    return ReachScript(key, start, side, duration, jnp.zeros(()), jnp.zeros((2, 3)))


def act(script: ReachScript, state: EnvState) -> tuple[Command, ReachScript, Command]:
    """Returns the disturbed command to execute, the script, and the undisturbed one to record."""
    dt = 1.0 / CONTROL_HZ
    elapsed = script.elapsed + dt
    s = jnp.clip(elapsed / script.duration, 0.0, 1.0)
    fraction = scripting.sloped(s)
    p = script.start + fraction * (state.layout.p - script.start)
    # A parabola, 1 at its middle: two ways around make demonstrations bimodal.
    p = p + 4.0 * fraction * (1.0 - fraction) * script.side
    noise = scripting.disturb(script.key, script.noise, state.step, jnp.full(3, DEVIATION))
    weight = jnp.clip((CALM - s) / CALM, 0.0, 1.0)  # undisturbed at the mark, where it must rest
    script = script.replace(elapsed=elapsed, noise=noise)
    return _command(p + weight * noise[1], state), script, _command(p, state)


def _command(p: jax.Array, state: EnvState) -> Command:
    return scripting.command(jnp.zeros(1), p[None], -jnp.ones(1), state)


AGENT = Agent(init, act)
