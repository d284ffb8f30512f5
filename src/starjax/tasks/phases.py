"""State machine of the one-arm scripts: each phase is a motion to a goal, or one of the jaws.

A phase's goal is set from the state at its start. The tool rises, approaches and descends; the
other phases are the task's own. A `Grasp` is the machine of scripts that grasp along a normal.
"""

import functools
import operator
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import flax.struct
import jax
import jax.numpy as jnp

from starjax.core.types import Agent, ArrayTree, Command
from starjax.sim.state import EnvState
from starjax.sim.task import CONTROL_HZ
from starjax.tasks import scripting

RAISE, APPROACH, DESCEND = range(3)  # the first phases of every script
ALIGNED = 0.6  # fraction of a descent after which the tool goes straight down
TURN_LEAD = 0.25  # s before the end of the approach at which the tool begins to turn
TURN_TIME = 0.80  # s the turn takes
# m that a tool rises on slowly in a second while the judge waits: it never stands still
RISE = 0.004
RISEN = 0.0005  # m below its height, from which a tool has risen


@flax.struct.dataclass
class PhaseScript:
    """Progress of a script in one episode.

    Attributes:
      key: of all draws, folded with the attempt or the step.
      phase, attempt: int32; an attempt begins with an approach.
      elapsed, duration: s.
      tempo: pace.
      start, goal, at: `[3]` position (m) or `[4]` roll (rad) and position, undisturbed, at the
        phase's ends and now.
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
    at: jax.Array
    jaws_from: jax.Array
    jaws: jax.Array
    noise: jax.Array


@flax.struct.dataclass
class GraspScript(PhaseScript):
    """Progress of a script that turns the jaws to a normal.

    Attributes:
      normal: `[3]`, of the grasped part, or its opposite: jaws are symmetric, and this keeps the
        roll on one branch.
      roll_from: rad, the roll at the start of the next turn.
      roll: rad.
    """

    normal: jax.Array
    roll_from: jax.Array
    roll: jax.Array


ScriptT = TypeVar("ScriptT", bound=PhaseScript)
GraspT = TypeVar("GraspT", bound=GraspScript)


class PhaseTable(NamedTuple):
    """Phases P.

    Attributes:
      duration: `[P]` s, the least one; 0 where jaws move, see `scripting.is_of_jaws`.
      speed: `[P]` m/s, the mean one.
      jaws: `[P]`, at the end: +1 open, -1 closed.
      tempo: range of an episode's pace.
    """

    duration: tuple[float, ...]
    speed: tuple[float, ...]
    jaws: tuple[float, ...]
    tempo: tuple[float, float]


class Grasp(NamedTuple):
    """Script of a grasp along a normal.

    Attributes:
      timing: of its phases.
      disturbance: `[P]`, its weight in each phase.
      deviation: `[4]` m and rad, of the disturbance.
      straight: phases that go straight down at the end.
      following: (GraspScript, EnvState) -> int32, the next phase.
      enter: (GraspScript, phase, EnvState) -> the script at the start of the phase.
      lead: (GraspScript) -> s since the start of the turn.
      starts_at_label: True if a phase starts at the recorded pose, else at the planned one; they
        differ by rounding.
    """

    timing: PhaseTable
    disturbance: tuple[float, ...]
    deviation: tuple[float, ...]
    straight: tuple[int, ...]
    following: Callable[[Any, EnvState], jax.Array]
    enter: Callable[[Any, jax.Array, EnvState], Any]
    lead: Callable[[Any], jax.Array]
    starts_at_label: bool = False


def begin(
    kind: Callable[..., ScriptT],
    timing: PhaseTable,
    key: jax.Array,
    at: jax.Array,
    **own: ArrayTree,
) -> ScriptT:
    """Returns a script of class `kind` before its first phase, with the task's own fields."""
    key_tempo, key = jax.random.split(key)
    low, high = timing.tempo
    zero, none, is_open = jnp.zeros(()), jnp.zeros((), jnp.int32), jnp.ones(())
    return kind(
        key=key,
        phase=none,
        attempt=none,
        elapsed=zero,
        duration=zero,
        tempo=jax.random.uniform(key_tempo, minval=low, maxval=high),
        start=at,
        goal=at,
        at=at,
        jaws_from=is_open,
        jaws=is_open,
        noise=jnp.zeros((2, 4)),
        **own,
    )


def grasp_fields() -> dict[str, jax.Array]:
    """Returns the fields of `GraspScript` before the first phase."""
    return {
        "normal": jnp.array([0.0, -1.0, 0.0]),
        "roll_from": jnp.zeros(()),
        "roll": jnp.zeros(()),
    }


def enter(
    script: ScriptT,
    timing: PhaseTable,
    phase: jax.Array,
    goals: list[jax.Array],
    **own: ArrayTree,
) -> ScriptT:
    """Returns the script at the start of `phase`, whose goal is that of `goals` `[P]`."""
    goal = jnp.stack(goals)[phase]
    length = jnp.linalg.norm(goal[-3:] - script.at[-3:])  # m: a goal may begin with a roll
    least, speed, jaws = (
        jnp.asarray(rows)[phase] for rows in (timing.duration, timing.speed, timing.jaws)
    )
    # Long ways at their mean speed; short ones no faster than the least time.
    duration = jnp.maximum(least, length / speed) / script.tempo
    limit = scripting.jaw_limit(script.jaws, jaws)
    # A tool that is high already rises no longer than its jaws take to let go.
    is_high = (phase == RAISE) & (length < RISEN)
    duration = jnp.where(is_high, limit - scripting.JAW_DELAY, duration)
    is_of_jaws = jnp.asarray(scripting.is_of_jaws(timing.jaws))[phase]
    return script.replace(
        phase=phase,
        elapsed=jnp.zeros(()),
        duration=jnp.where(is_of_jaws, limit, duration),
        start=script.at,
        goal=goal,
        jaws_from=script.jaws,
        **own,
    )


def advance(
    script: ScriptT, timing: PhaseTable, after: ScriptT, state: EnvState
) -> tuple[ScriptT, jax.Array]:
    """Returns the script a control step later, `after` if its phase is over, and the time's share.

    Jaws are those of the new step; the position is the caller's to set.
    """
    is_over = scripting.is_over(script, timing.jaws, state)
    script = jax.tree.map(lambda a, b: jnp.where(is_over, a, b), after, script)
    elapsed = script.elapsed + 1.0 / CONTROL_HZ
    # In any phase, by the time since its start: jaws that still move finish their motion.
    jaws = scripting.jaws(script.jaws_from, jnp.asarray(timing.jaws)[script.phase], elapsed)
    s = jnp.clip(elapsed / script.duration, 0.0, 1.0)
    return script.replace(elapsed=elapsed, jaws=jaws), s


def horizontal(normal: jax.Array) -> jax.Array:
    """Returns the horizontal unit vector `[3]` along a normal `[3]`."""
    out = normal * jnp.array([1.0, 1.0, 0.0])
    return out / jnp.maximum(jnp.linalg.norm(out), 1e-6)  # zero for a vertical normal


def towards_arm(normal: jax.Array) -> jax.Array:
    """Returns a normal `[3]` or its opposite, against the world's y: it keeps to one branch."""
    return normal * jnp.where(normal[1] > 0, -1.0, 1.0)


def agent(init: Callable[[jax.Array, EnvState], Any], grasp: Grasp) -> Agent:
    """Makes the demonstrator of a grasp."""

    def act(script: GraspT, state: EnvState) -> tuple[Command, GraspT, Command]:
        after = grasp.enter(script, grasp.following(script, state), state)
        script, s = advance(script, grasp.timing, after, state)
        # On the way down it is above its goal before anything can touch.
        is_straight = functools.reduce(operator.or_, (script.phase == p for p in grasp.straight))
        aligned = jnp.where(is_straight, ALIGNED, 1.0)
        aside = scripting.sloped(jnp.minimum(s / aligned, 1.0))
        fraction = jnp.stack([aside, aside, scripting.sloped(s)])
        script = script.replace(at=script.start + fraction * (script.goal - script.start))
        deviation = jnp.array(grasp.deviation)
        noise = scripting.disturb(script.key, script.noise, state.step, deviation)
        script = script.replace(roll=_roll(script, grasp.lead(script), state), noise=noise)
        weight = jnp.asarray(grasp.disturbance)[script.phase]
        # The low-passed copy of the noise, which a robot can follow.
        moved = weight * noise[1] * jnp.where(script.phase == DESCEND, 1.0 - s, 1.0)
        rough = _command(script.roll + moved[3], script.at + moved[:3], script, state)
        label = _command(script.roll, script.at, script, state)
        if grasp.starts_at_label:
            script = script.replace(at=label.pose.p[0])
            script = script.replace(roll=_roll(script, grasp.lead(script), state))
        return rough, script, label

    return Agent(init, act)


def _roll(script: GraspScript, lead: jax.Array, state: EnvState) -> jax.Array:
    """Returns the roll (rad) at the present position, turning towards the normal."""
    R = _command(jnp.zeros(()), script.at, script, state).pose.R[0]
    # R_z(roll) takes y to the normal: n . x' = 0 for x' = cos x + sin y.
    on_normal = jnp.arctan2(-script.normal @ R[:, 0], script.normal @ R[:, 1])
    turned = jnp.clip(lead * script.tempo / TURN_TIME, 0.0, 1.0)
    turned = jnp.where(script.phase > DESCEND, 1.0, jnp.where(script.phase == RAISE, 0.0, turned))
    weight = 0.5 - 0.5 * jnp.cos(jnp.pi * turned)  # smooth at both ends
    return script.roll_from + weight * (on_normal - script.roll_from)


def _command(roll: jax.Array, p: jax.Array, script: GraspScript, state: EnvState) -> Command:
    return scripting.command(roll[None], p[None], script.jaws[None], state)
