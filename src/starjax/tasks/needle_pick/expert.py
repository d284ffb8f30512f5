"""Scripted expert of needle pick: above the wire, down, close, lift, hold.

It draws one of the inner segments that need little roll (never by the trocar) and a pace, is
disturbed on purpose, and starts over if the needle is not held. It comes in along the segment's
normal: the path determines the roll.
"""

import flax.struct
import jax
import jax.numpy as jnp

from starjax.sim.state import EnvState
from starjax.tasks import phases
from starjax.tasks.needle_pick import task
from starjax.tasks.phases import APPROACH, DESCEND, RAISE, TURN_LEAD

CLOSE, LIFT, HOLD = range(3, 6)
TIMING = phases.PhaseTable(
    duration=(0.5, 1.2, 0.9, 0.0, 0.9, 1.0),
    speed=(0.04, 0.04, 0.024, 1.0, 0.02, 1.0),
    jaws=(1.0, 1.0, 1.0, -1.0, -1.0, -1.0),
    tempo=(0.85, 1.2),
)
HOVER = 0.02  # m above the grasp point
HOVER_OUT = 0.006  # m out from it along the segment's normal
GRASP_ABOVE = 0.001  # m of the tip above the wire: the pads' ends lie 1.5 mm below it
LIFT_HEIGHT = 0.027  # m
TOP = 0.012  # m above that, to which it rises on in a hold
SKEW = 0.15  # sine of the angle between jaws and the world's y at which a preference shows
MIDDLES, TANGENTS = task.segments()


@flax.struct.dataclass
class NeedleScript(phases.GraspScript):
    """Progress of the script in one episode.

    Attributes:
      segment: int32, of the wire.
    """

    segment: jax.Array


def init(key: jax.Array, state: EnvState) -> NeedleScript:
    """Starts the script of an episode."""
    own = phases.grasp_fields() | {"segment": jnp.zeros((), jnp.int32)}
    script = phases.begin(NeedleScript, TIMING, key, state.pose.p[0], **own)
    return _enter(script, jnp.asarray(APPROACH, jnp.int32), state)


def _enter(script: NeedleScript, phase: jax.Array, state: EnvState) -> NeedleScript:
    """Begins `phase`: chooses the segment if it is an approach, sets goal and duration."""
    needle, tip = state.measurements.needle, script.at
    is_approach = phase == APPROACH
    attempt = script.attempt + is_approach
    # Jaws close across the wire: the horizontal normal of each segment, in the world.
    normals = jnp.cross(jnp.asarray(TANGENTS), jnp.array([0.0, 0.0, 1.0])) @ needle.R.T
    # Pads of a tool with a wrist are as wide as a segment. In C MuJoCo, not in our physics, they
    # touch the point from the segment next to it.
    last = task.SEGMENTS - (1 if state.wrist is None else 2)
    inner = (jnp.arange(task.SEGMENTS) > 0) & (jnp.arange(task.SEGMENTS) < last)
    score = jnp.where(inner, -jnp.abs(normals[:, 0]) / SKEW, -jnp.inf)
    # Softmax of -|sin| / SKEW: mostly segments that need little roll, not always the same one.
    drawn = jax.random.categorical(jax.random.fold_in(script.key, attempt), score)
    segment = jnp.where(is_approach, drawn, script.segment)
    out = phases.horizontal(normals[segment])  # away from the wire, for a visible descent
    # R_world_needle p_needle + p
    grasp = needle.p + needle.R @ jnp.asarray(MIDDLES)[segment] + jnp.array([0.0, 0.0, GRASP_ABOVE])
    high = state.layout.needle.p[2] + GRASP_ABOVE + LIFT_HEIGHT + TOP
    goals = [
        tip.at[2].set(jnp.maximum(tip[2], HOVER)),  # RAISE
        grasp + HOVER_OUT * out + jnp.array([0.0, 0.0, HOVER]),  # APPROACH
        grasp,
        tip,
        tip.at[2].add(LIFT_HEIGHT),  # LIFT
        tip.at[2].set(jnp.clip(high, tip[2], tip[2] + phases.RISE)),  # HOLD: it rises on slowly
    ]
    return phases.enter(
        script,
        TIMING,
        phase,
        goals,
        attempt=attempt,
        segment=segment,
        # Fixed once the wire is held: the needle turns with the jaws, and would turn them on and
        # on.
        normal=jnp.where(phase <= DESCEND, phases.towards_arm(out), script.normal),
        # One turn for approach and descent
        roll_from=jnp.where(phase <= APPROACH, script.roll, script.roll_from),
    )


def _following(script: NeedleScript, state: EnvState) -> jax.Array:
    """Returns the next phase, the first one if the needle is not held."""
    is_lost = (script.phase >= LIFT) & ~state.measurements.touch
    following = jnp.where(is_lost, RAISE, jnp.minimum(script.phase + 1, HOLD))
    return following.astype(jnp.int32)


def _lead(script: NeedleScript) -> jax.Array:
    is_approach = script.phase == APPROACH
    return TURN_LEAD + script.elapsed - jnp.where(is_approach, script.duration, 0.0)


GRASP = phases.Grasp(
    timing=TIMING,
    disturbance=(1.0, 1.0, 0.5, 0.0, 0.2, 0.1),
    deviation=(0.0012, 0.0012, 0.0012, 0.05),
    straight=(DESCEND,),
    following=_following,
    enter=_enter,
    lead=_lead,
)
AGENT = phases.agent(init, GRASP)
