"""Entries into the middle of a phase: the motion keeps the tool's speed, jaws their opening.

From rest the entry is that of the script itself.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from starjax.sim.state import EnvState
from starjax.tasks import phases, scripting
from starjax.tasks.phases import GraspT

ARRIVED = 0.0005  # m from a goal, within which the next phase begins
OPEN = 0.98  # opening from which jaws count as open, and -OPEN as closed
LEFT = 0.2  # the least fraction of a way or turn that is left, where it determines its start
ROUNDS = 4  # for the search for the duration, which depends on the way's length
LONGEST = 0.1  # m, of a whole way: the longest between pegs
_SHARE = np.linspace(0.0, 0.95, 96)


def _pace(share: jax.Array, slope: jax.Array | float) -> jax.Array:
    """Returns the speed of `scripting.sloped` as a multiple of the way that is left."""
    speed = jnp.minimum(jnp.minimum(share, 1.0 - share) / slope, 1.0) / (1.0 - slope)
    return speed / (1.0 - scripting.sloped(share, slope))


def share(
    left: jax.Array,
    speed: jax.Array,
    duration: jax.Array,
    slope: jax.Array | float = scripting.SLOPE,
) -> jax.Array:
    """Returns the fraction of its time at which a smooth motion has this much left at this speed.

    Args:
      left: m.
      speed: m/s, towards the goal.
      duration: s, of the whole motion.
      slope: as in `scripting.sloped`.
    """
    shares = jnp.asarray(_SHARE)
    share = jnp.interp(speed * duration / left, _pace(shares, slope), shares)
    # A tool that is too fast to stop in time is at the end of the longest way.
    most = jnp.interp(1.0 - left / LONGEST, scripting.sloped(shares, slope), shares)
    return jnp.minimum(share, most)


def enter(
    begin: Callable[[GraspT, jax.Array, EnvState], GraspT],
    grasp: phases.Grasp,
    script: GraspT,
    phase: jax.Array,
    state: EnvState,
) -> GraspT:
    """Returns the script in the middle of `phase`, or of the next one if its goal is reached.

    Args:
      begin: (script, phase, state) -> the script at the phase's start.
      grasp: of the script.
      script: at the tool's place.
      phase: int32.
      state: at the entry.
    """
    first = begin(script, phase, state)
    way = jnp.linalg.norm(first.goal - first.at)
    last = len(grasp.timing.duration) - 1
    following = begin(script, jnp.minimum(phase + 1, last), state)
    # A phase that stays in place has no way, and lasts its time.
    is_there = (way > 0.0) & (way < ARRIVED)
    script = jax.tree.map(lambda a, b: jnp.where(is_there, a, b), following, first)
    return _turning(grasp, _moving(grasp, script, state), state)


def _moving(grasp: phases.Grasp, script: GraspT, state: EnvState) -> GraspT:
    """Returns the script at the time at which its phase has the tool's speed."""
    timing, way = grasp.timing, script.goal - script.at
    is_straight = jnp.isin(script.phase, jnp.array(grasp.straight))
    # The height decides in a straight phase, which ends early in the other directions.
    along = jnp.where(is_straight, way * jnp.array([0.0, 0.0, 1.0]), way)
    left = jnp.linalg.norm(along)
    is_still = left < ARRIVED
    is_still |= jnp.asarray(scripting.is_of_jaws(timing.jaws))[script.phase]
    left = jnp.maximum(left, ARRIVED)
    speed = jnp.maximum(state.velocity[0, :3] @ along / left, 0.0)
    least, mean = (jnp.asarray(rows)[script.phase] for rows in (timing.duration, timing.speed))
    duration, at = script.duration, jnp.zeros(())
    for _ in range(ROUNDS):
        at = share(left, speed, duration)
        whole = left / (1.0 - scripting.sloped(at))
        duration = jnp.maximum(least, whole / mean) / script.tempo
    aligned = jnp.where(is_straight, phases.ALIGNED, 1.0)
    aside = scripting.sloped(jnp.minimum(at / aligned, 1.0))
    done = jnp.stack([aside, aside, scripting.sloped(at)])
    start = script.goal - way / jnp.maximum(1.0 - done, jnp.array([LEFT, LEFT, 1e-6]))
    return script.replace(
        elapsed=jnp.where(is_still, 0.0, at * duration),
        duration=jnp.where(is_still, script.duration, duration),
        start=jnp.where(is_still, script.start, start),
    )


def _turning(grasp: phases.Grasp, script: GraspT, state: EnvState) -> GraspT:
    """Returns the script with the start of its turn, which passes the tool's roll now."""
    at_start, at_end = script.replace(roll_from=0.0), script.replace(roll_from=1.0)
    lead = grasp.lead(script)
    from_zero, from_one = (phases._roll(one, lead, state) for one in (at_start, at_end))
    left = from_one - from_zero
    turned = from_zero / jnp.maximum(1.0 - left, 1e-6)
    begun = turned + (script.roll - turned) / jnp.maximum(left, LEFT)
    return script.replace(roll_from=jnp.where(left < 1.0, begun, script.roll_from))
