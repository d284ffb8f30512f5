"""Scripted expert of needle pick: above the wire, down, close, lift, hold.

It draws one of the inner segments that need little roll (never by the trocar) and a pace, is
disturbed on purpose, and starts over if the needle is not held. It comes in along the segment's
normal: the path determines the roll.
"""

import flax.struct
import jax
import jax.numpy as jnp

from starjax.sim.state import EnvState
from starjax.sim.tasks import scripting
from starjax.sim.tasks.base import CONTROL_HZ
from starjax.sim.tasks.needle_pick import task
from starjax.types import Agent, Command

RAISE, APPROACH, DESCEND, CLOSE, LIFT, HOLD = range(6)
# Least duration (s) and mean speed (m/s) of each phase, and jaws: +1 open, -1 closed at its end.
DURATION = (0.5, 1.2, 0.9, 0.4, 0.9, 1.0)
SPEED = (0.04, 0.04, 0.024, 1.0, 0.02, 1.0)
JAWS = (1.0, 1.0, 1.0, -1.0, -1.0, -1.0)
DISTURBANCE = (1.0, 1.0, 0.5, 0.0, 0.2, 0.1)  # its weight in each phase

TEMPO = (0.85, 1.2)  # range of an episode's pace
TURN_LEAD = 0.25  # s before the end of the approach at which the tool begins to turn
TURN_TIME = 0.80  # s the turn takes
ALIGNED = 0.6  # fraction of a descent after which it goes straight down
HOVER = 0.02  # m above the grasp point
HOVER_OUT = 0.006  # m out from it along the segment's normal
GRASP_ABOVE = 0.001  # m of the tip above the wire: the pads' ends lie 1.5 mm below it
LIFT_HEIGHT = 0.027  # m
SKEW = 0.15  # sine of the angle between jaws and the world's y at which a preference shows
DEVIATION = (0.0012, 0.0012, 0.0012, 0.05)  # m and rad, of the disturbance
MIDDLES, TANGENTS = task.segments()


@flax.struct.dataclass
class NeedleScript:
    """Progress of the script in one episode.

    Attributes:
      key: of all draws, folded with the attempt or the step.
      phase, attempt: int32.
      elapsed, duration: s.
      tempo: pace.
      start, goal, p: `[3]` m, undisturbed positions at the phase's ends and now.
      segment: int32, of the wire.
      normal: `[3]`, across it, or its opposite: jaws are symmetric, and this keeps the roll on one
        branch.
      roll_from: rad, the roll at the start of the next turn.
      roll: rad.
      jaws_from, jaws: openings.
      noise: `[2, 4]` disturbance of position (m) and roll (rad), rough and smooth.
    """

    key: jax.Array
    phase: jax.Array
    attempt: jax.Array
    elapsed: jax.Array
    duration: jax.Array
    tempo: jax.Array
    start: jax.Array
    goal: jax.Array
    p: jax.Array
    segment: jax.Array
    normal: jax.Array
    roll_from: jax.Array
    roll: jax.Array
    jaws_from: jax.Array
    jaws: jax.Array
    noise: jax.Array


def init(key: jax.Array, state: EnvState) -> NeedleScript:
    """Starts the script of an episode."""
    key_tempo, key = jax.random.split(key)
    p, zero, none = state.pose.p[0], jnp.zeros(()), jnp.zeros((), jnp.int32)
    tempo = jax.random.uniform(key_tempo, minval=TEMPO[0], maxval=TEMPO[1])
    down = jnp.array([0.0, -1.0, 0.0])
    script = NeedleScript(
        key, none, none, zero, zero, tempo, p, p, p, none, down, zero, zero, jnp.ones(()),
        jnp.ones(()), jnp.zeros((2, 4)),
    )  # fmt: skip
    return _enter(script, jnp.asarray(APPROACH, jnp.int32), state)


def _enter(script: NeedleScript, phase: jax.Array, state: EnvState) -> NeedleScript:
    """Begins `phase`: choose the segment if it is an approach, set goal and duration."""
    needle, tip = state.measurements.needle, script.p
    is_approach = phase == APPROACH
    attempt = script.attempt + is_approach
    normals = jnp.cross(jnp.asarray(TANGENTS), jnp.array([0.0, 0.0, 1.0])) @ needle.R.T
    inner = (jnp.arange(task.SEGMENTS) > 0) & (jnp.arange(task.SEGMENTS) < task.SEGMENTS - 1)
    score = jnp.where(inner, -jnp.abs(normals[:, 0]) / SKEW, -jnp.inf)
    drawn = jax.random.categorical(jax.random.fold_in(script.key, attempt), score)
    segment = jnp.where(is_approach, drawn, script.segment)
    out = normals[segment] * jnp.array([1.0, 1.0, 0.0])
    out = out / jnp.maximum(jnp.linalg.norm(out), 1e-6)
    normal = out * jnp.where(out[1] > 0, -1.0, 1.0)
    grasp = needle.p + needle.R @ jnp.asarray(MIDDLES)[segment] + jnp.array([0.0, 0.0, GRASP_ABOVE])
    goals = jnp.stack(
        [
            tip.at[2].set(jnp.maximum(tip[2], HOVER)),
            grasp + HOVER_OUT * out + jnp.array([0.0, 0.0, HOVER]),
            grasp,
            tip,
            tip.at[2].add(LIFT_HEIGHT),
            tip,
        ]
    )
    goal = goals[phase]
    way = jnp.linalg.norm(goal - tip)
    duration = jnp.maximum(jnp.asarray(DURATION)[phase], way / jnp.asarray(SPEED)[phase])
    return script.replace(
        phase=phase,
        attempt=attempt,
        elapsed=jnp.zeros(()),
        duration=duration / script.tempo,
        start=tip,
        goal=goal,
        segment=segment,
        normal=jnp.where(phase <= DESCEND, normal, script.normal),
        roll_from=jnp.where(phase <= APPROACH, script.roll, script.roll_from),
        jaws_from=script.jaws,
    )


def act(script: NeedleScript, state: EnvState) -> tuple[Command, NeedleScript, Command]:
    """Returns the disturbed command to execute, the script, and the undisturbed one to record."""
    dt = 1.0 / CONTROL_HZ
    is_over = script.elapsed >= script.duration - 1e-6
    after = _enter(script, _following(script, state), state)
    script = jax.tree.map(lambda a, b: jnp.where(is_over, a, b), after, script)
    elapsed = script.elapsed + dt
    s = jnp.clip(elapsed / script.duration, 0.0, 1.0)
    # On the way down it is above its goal before anything can touch.
    aligned = jnp.where(script.phase == DESCEND, ALIGNED, 1.0)
    aside = scripting.minimum_jerk(jnp.minimum(s / aligned, 1.0))
    fraction = jnp.stack([aside, aside, scripting.minimum_jerk(s)])
    p = script.start + fraction * (script.goal - script.start)
    target = jnp.asarray(JAWS)[script.phase]
    jaws = scripting.jaws(script.jaws_from, target, elapsed)
    script = script.replace(elapsed=elapsed, p=p, jaws=jaws)
    script = script.replace(roll=_roll(script, state))
    noise = scripting.disturb(script.key, script.noise, state.step, jnp.array(DEVIATION))
    weight = jnp.asarray(DISTURBANCE)[script.phase]
    moved = weight * noise[1] * jnp.where(script.phase == DESCEND, 1.0 - s, 1.0)
    script = script.replace(noise=noise)
    rough = _command(script.roll + moved[3], p + moved[:3], jaws, state)
    return rough, script, _command(script.roll, p, jaws, state)


def _following(script: NeedleScript, state: EnvState) -> jax.Array:
    """Returns the next phase, the first one if the needle is not held."""
    is_lost = (script.phase >= LIFT) & ~state.measurements.touch
    following = jnp.where(is_lost, RAISE, jnp.minimum(script.phase + 1, HOLD))
    return following.astype(jnp.int32)


def _roll(script: NeedleScript, state: EnvState) -> jax.Array:
    """Returns the roll (rad) at the present position, turning towards the segment's normal."""
    R = _command(jnp.zeros(()), script.p, script.jaws, state).pose.R[0]
    on_wire = jnp.arctan2(-script.normal @ R[:, 0], script.normal @ R[:, 1])
    is_approach = script.phase == APPROACH
    lead = TURN_LEAD + script.elapsed - jnp.where(is_approach, script.duration, 0.0)
    turned = jnp.clip(lead * script.tempo / TURN_TIME, 0.0, 1.0)
    turned = jnp.where(script.phase > DESCEND, 1.0, jnp.where(script.phase == RAISE, 0.0, turned))
    weight = 0.5 - 0.5 * jnp.cos(jnp.pi * turned)
    return script.roll_from + weight * (on_wire - script.roll_from)


def _command(roll: jax.Array, p: jax.Array, jaws: jax.Array, state: EnvState) -> Command:
    return scripting.command(roll[None], p[None], jaws[None], state)


AGENT = Agent(init, act)
