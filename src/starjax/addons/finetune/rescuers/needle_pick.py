"""Expert of needle pick from any state: a held needle is lifted or held on, else taken up.

Open jaws above the wire, or about it, come down and grip. A needle held by its point is put down
first: dropped, it rolls away. Beyond rescue: a needle out of the tool's reach.
"""

import jax
import jax.numpy as jnp

from starjax.addons.finetune.rescuers import midway, way_in
from starjax.sim.rescuer import Rescuer, entry
from starjax.sim.state import EnvState
from starjax.tasks import phases
from starjax.tasks.needle_pick import expert, task
from starjax.tasks.phases import APPROACH, DESCEND, RAISE

PUT, FREE = expert.HOLD + 1, expert.HOLD + 2
ROOM = way_in.Room(pads=0.002, clearance=0.002, top=expert.HOVER)  # 0.7 mm less than there is
SINKS = 0.003  # m, by which a needle that turns in the jaws sinks while it is held up
RARE = 3.0  # multiples of `expert.SKEW` beyond the best segment, which the expert takes rarely
_TABLE = expert.TIMING
TIMING = phases.PhaseTable(
    duration=(*_TABLE.duration, 0.9, 0.0),
    speed=(*_TABLE.speed, 0.02, 1.0),
    jaws=(*_TABLE.jaws, -1.0, 1.0),
    tempo=_TABLE.tempo,
)


def _enter(script: expert.NeedleScript, phase: jax.Array, state: EnvState) -> expert.NeedleScript:
    """Begins `phase`, one of the expert's or its own."""
    usual = expert._enter(script, jnp.minimum(phase, expert.HOLD), state)
    needle, tip = state.measurements.needle, script.at
    lowest = jnp.min(needle.p[2] + jnp.asarray(expert.MIDDLES) @ needle.R[2])
    ground = state.layout.needle.p[2]
    down = tip.at[2].set(jnp.maximum(tip[2] - (lowest - ground), ground + expert.GRASP_ABOVE))
    own = phases.enter(script, TIMING, phase, [*[tip] * PUT, down, tip])
    return jax.tree.map(lambda a, b: jnp.where(phase >= PUT, a, b), own, usual)


def _following(script: expert.NeedleScript, state: EnvState) -> jax.Array:
    usual = expert.GRASP.following(script, state)
    own = jnp.where(script.phase == PUT, FREE, RAISE)
    return jnp.where(script.phase >= PUT, own, usual).astype(jnp.int32)


def resume(key: jax.Array, state: EnvState) -> expert.NeedleScript:
    """Starts the script at this state."""
    script, now, found = expert.init(key, state), entry(state), state.measurements
    is_up = found.needle.p[2] > state.layout.needle.p[2] + task.LIFT + SINKS
    is_low = now.p[0, 2] < expert.HOVER
    segment, is_coming, is_about = _way_in(state)
    held = jnp.where(is_up, expert.HOLD, expert.LIFT)
    # A grasp of the point never succeeds.
    held = jnp.where(found.sticks, PUT, held)
    free = jnp.where(is_coming, DESCEND, jnp.where(is_low, RAISE, APPROACH))
    phase = jnp.where(now.holds[0], held, free)
    is_closing = is_about & ~is_up & (jnp.abs(now.jaws[0]) < midway.OPEN)
    phase = jnp.where(is_closing, expert.CLOSE, phase)
    script = script.replace(
        attempt=jnp.zeros((), jnp.int32),
        segment=segment,
        at=now.p[0],
        jaws_from=now.jaws[0],
        jaws=now.jaws[0],
        # The jaws' own direction: the roll of a held needle does not jump.
        normal=jnp.where(now.holds[0], state.pose.R[0, :, 1], script.normal),
        roll_from=now.roll[0],
        roll=now.roll[0],
    )
    return midway.enter(_enter, _GRASP, script, phase.astype(jnp.int32), state)


def _way_in(state: EnvState) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Returns the segment that the tip is nearest to, int32, and where on the way to it the tip is.

    See `way_in.of`.
    """
    needle, tip = state.measurements.needle, state.pose.p[0]
    across = jnp.cross(jnp.asarray(expert.TANGENTS), jnp.array([0.0, 0.0, 1.0])) @ needle.R.T
    grasps = needle.p + jnp.asarray(expert.MIDDLES) @ needle.R.T
    ways = grasps + jnp.array([0.0, 0.0, expert.GRASP_ABOVE]) - tip
    aside = jnp.linalg.norm(ways[:, :2], axis=-1)
    last = task.SEGMENTS - (1 if state.wrist is None else 2)  # as of the expert
    inner = (jnp.arange(task.SEGMENTS) > 0) & (jnp.arange(task.SEGMENTS) < last)
    skew = jnp.where(inner, jnp.abs(across[:, 0]), jnp.inf)
    can = skew < jnp.min(skew) + RARE * expert.SKEW
    segment = jnp.argmin(jnp.where(can, aside, jnp.inf)).astype(jnp.int32)
    return segment, *way_in.of(ROOM, ways[segment], aside[segment], across[segment], state)


_GRASP = expert.GRASP._replace(
    timing=TIMING,
    disturbance=(*expert.GRASP.disturbance, 0.1, 0.0),
    following=_following,
    enter=_enter,
)
RESCUER = Rescuer(resume, phases.agent(expert.init, _GRASP).act, version=2)
