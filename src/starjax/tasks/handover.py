"""Scripted hand-over of an object from one arm to the other, in common phases of both arms.

A `Play` has the phases: durations, jaws, turns and goals. Its memory is a `HandoverScript`, with a
field `held` of the task's own. As with one arm, rolls follow from coming tip positions and trocars:
a tool turns on its way in, which begins `OUT` to one side along the jaws' opening direction.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from starjax.core.types import Agent, Command
from starjax.sim.state import EnvState
from starjax.sim.task import CONTROL_HZ
from starjax.tasks import scripting

DEVIATION = (0.001, 0.001, 0.001, 0.04)  # m and rad, of each arm's disturbance
OUT = 0.006  # m along the normal, the start of a tool's way in to its grasp


@flax.struct.dataclass
class HandoverScript:
    """Progress of the script in one episode. Arrays `[2, ...]` are of both arms.

    Attributes:
      key: of all draws.
      phase: int32.
      elapsed, duration: s, of the phase.
      tempo: pace.
      held: the task's own, the held part of the object.
      start, goal, p: `[2, 3]` m, undisturbed positions.
      normal: `[2, 3]`, the jaws' opening directions.
      roll_from, roll_to, roll: `[2]` rad.
      jaws_from, jaws: `[2]` openings.
      noise: `[2, 8]` disturbance of both arms, rough and smooth.
    """

    key: jax.Array
    phase: jax.Array
    elapsed: jax.Array
    duration: jax.Array
    tempo: jax.Array
    held: Any
    start: jax.Array
    goal: jax.Array
    p: jax.Array
    normal: jax.Array
    roll_from: jax.Array
    roll_to: jax.Array
    roll: jax.Array
    jaws_from: jax.Array
    jaws: jax.Array
    noise: jax.Array


class Play(NamedTuple):
    """Motions of both arms, phase by phase P.

    Attributes:
      choose: (key, EnvState) -> (key, tempo, held), the draws at the start.
      duration: `[P]` s at tempo 1; 0 where jaws move, see `scripting.is_of_jaws`.
      jaws: `[P, 2]`, at the end of each phase.
      aligned: `[P]`, fraction of a phase after which a tool goes straight down.
      turned: `[P]`, fraction of a phase after which a tool has turned.
      looks: `[P, 2]` bool, True for arms that turn to their grasp; others keep their roll.
      weight: (phase, fraction of the way) -> weight of the disturbance.
      following: (HandoverScript, EnvState) -> int32, the next phase.
      goals: (HandoverScript, EnvState) -> positions `[P, 2, 3]` m, and the jaws' opening
        directions `[2, 3]`, or `[3]` for both.
      command: (rolls `[2]`, tips `[2, 3]`, openings `[2]`, EnvState) -> Command.
    """

    choose: Callable[..., tuple[jax.Array, jax.Array, Any]]
    duration: np.ndarray
    jaws: np.ndarray
    aligned: np.ndarray
    turned: np.ndarray
    looks: np.ndarray
    weight: Callable[[jax.Array, jax.Array], jax.Array]
    following: Callable[[HandoverScript, EnvState], jax.Array]
    goals: Callable[[HandoverScript, EnvState], tuple[jax.Array, jax.Array]]
    command: Callable[..., Command] = scripting.command


def agent(play: Play) -> Agent:
    """Makes the demonstrator of a play."""

    def init(key: jax.Array, state: EnvState) -> HandoverScript:
        key, tempo, held = play.choose(key, state)
        p, zero, open_ = state.pose.p, jnp.zeros(2), jnp.ones(2)
        script = HandoverScript(
            key=key,
            phase=jnp.zeros((), jnp.int32),
            elapsed=jnp.zeros(()),
            duration=jnp.zeros(()),
            tempo=tempo,
            held=held,
            start=p,
            goal=p,
            p=p,
            normal=jnp.tile(jnp.array([0.0, -1.0, 0.0]), (2, 1)),
            roll_from=zero,
            roll_to=zero,
            roll=zero,
            jaws_from=open_,
            jaws=open_,
            noise=jnp.zeros((2, 8)),
        )
        return _enter(play, script, jnp.zeros((), jnp.int32), state)

    def act(script: HandoverScript, state: EnvState) -> tuple[Command, HandoverScript, Command]:
        return _act(play, script, state)

    return Agent(init, act)


def _act(
    play: Play, script: HandoverScript, state: EnvState
) -> tuple[Command, HandoverScript, Command]:
    """Returns the disturbed commands to execute, the script, and the undisturbed ones to record."""
    is_over = scripting.is_over(script, play.jaws, state)
    after = _enter(play, script, play.following(script, state), state)
    script = jax.tree.map(lambda a, b: jnp.where(is_over, a, b), after, script)
    elapsed = script.elapsed + 1.0 / CONTROL_HZ
    s = jnp.clip(elapsed / script.duration, 0.0, 1.0)  # share of the phase's time
    # On the way down a tool is above its goal before anything can touch.
    aside, turned, fraction = progress(play, script, s)
    deviation = jnp.array(DEVIATION * 2)
    noise = scripting.disturb(script.key, script.noise, state.step, deviation)
    target = jnp.asarray(play.jaws, jnp.float32)[script.phase]
    script = script.replace(
        elapsed=elapsed,
        # x, y ahead of z
        p=script.start + jnp.stack([aside, aside, fraction]) * (script.goal - script.start),
        roll=script.roll_from + turned * (script.roll_to - script.roll_from),
        jaws=scripting.jaws(script.jaws_from, target, elapsed),
        noise=noise,
    )
    moved = play.weight(script.phase, fraction) * noise[1].reshape(2, 4)  # [A, (x, y, z, roll)]
    roll, p = script.roll + moved[:, 3], script.p + moved[:, :3]
    rough = play.command(roll, p, script.jaws, state)
    # The label is undisturbed: it shows how to come back from where the disturbance has led.
    return rough, script, play.command(script.roll, script.p, script.jaws, state)


def progress(play: Play, script: HandoverScript, s: jax.Array) -> tuple[jax.Array, ...]:
    """Returns the fractions of the way in x and y, of the turn, and of the way in z, at share `s`.

    A policy that executes few commands of a plan does not begin a way whose first commands hardly
    move: with slopes of 0.36 s it stayed for seconds where lift and carry meet.
    """
    ends = [jnp.asarray(at, jnp.float32)[script.phase] for at in (play.aligned, play.turned)]
    return tuple(
        scripting.sloped(jnp.minimum(s / at, 1.0), scripting.slope(at * script.duration))
        for at in (*ends, 1.0)
    )


def _enter(play: Play, script: HandoverScript, phase: jax.Array, state: EnvState) -> HandoverScript:
    """Begins `phase` with goals from the present state."""
    goals, normal = play.goals(script, state)
    goal = goals[phase]
    normals = jnp.where(jnp.asarray(play.looks)[phase][:, None], normal, script.normal)
    # Rolls are counted from roll 0 at the goal, where the turn must be right.
    at_zero = play.command(jnp.zeros(2), goal, script.jaws, state).pose.R
    is_of_jaws = jnp.asarray(scripting.is_of_jaws(play.jaws))[phase]
    limit = scripting.jaw_limit(script.jaws, jnp.asarray(play.jaws, jnp.float32)[phase])
    duration = jnp.asarray(play.duration, jnp.float32)[phase] / script.tempo
    return script.replace(
        phase=phase,
        elapsed=jnp.zeros(()),
        duration=jnp.where(is_of_jaws, limit, duration),
        start=script.p,
        goal=goal,
        normal=normals,
        roll_from=script.roll,
        # Jaws are symmetric
        roll_to=scripting.nearer_half(scripting.turn_to(normals, at_zero), script.roll),
        jaws_from=script.jaws,
    )
