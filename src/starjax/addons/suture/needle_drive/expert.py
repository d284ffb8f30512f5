"""Scripted expert of needle drive: above the entry, down, along the needle's arc, hold.

It commands the needle's poses on the bite's path; the tip follows from the grasp as it is measured
when a phase begins, and the wrist's angles from the measured trocar. It is disturbed on purpose on
its way to the pad. A needle that is off its path returns to it on the arc, and a wrist with slack
cables is led.
"""

from collections.abc import Callable

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from starjax.addons.suture import slack
from starjax.addons.suture.needle_drive import task
from starjax.addons.suture.tissue import needle as needles
from starjax.addons.suture.tissue.needle import Needle
from starjax.core.types import Agent, Command, Pose
from starjax.sim.state import EnvState
from starjax.tasks import phases, scripting, wrist_script
from starjax.tasks.phases import APPROACH, DESCEND, RAISE
from starjax.tasks.wrist_script import tip_of

DRIVE, HOLD = range(3, 5)
TIMING = phases.PhaseTable(
    duration=(0.5, 1.7, 0.9, 0.0, 1.0),
    speed=(0.04, 0.03, 0.02, 1.0, 1.0),
    jaws=(-1.0, -1.0, -1.0, -1.0, -1.0),
    tempo=(0.85, 1.2),
)
DISTURBANCE = (1.0, 1.0, 0.5, 0.0, 0.0)  # its weight in each phase
HIGH = 0.04  # m, of the tip: there the needle may turn
HOVER = 0.015  # m above the start of the arc
BEFORE = float(np.deg2rad(10.0))  # rad on the arc from there to the entry
EMERGE = 1.2 * task.EMERGED  # m of wire past the exit
TURN_SPEED = float(np.deg2rad(24.0))  # rad/s on the arc, the mean


@flax.struct.dataclass
class DriveScript(wrist_script.WristScript):
    """Progress of the script in one episode.

    Attributes:
      turn: rad, the needle's on the path at the start of the drive.
      held: pose_tip_needle at the phase's start.
      lead: of the commands.
    """

    turn: jax.Array
    held: Pose
    lead: slack.Lead


Plane = Callable[[EnvState], ArrayLike]


def vertical(state: EnvState) -> ArrayLike:
    """Returns the direction `[3]` up in a vertical plane of the needle's arc."""
    return needles.VERTICAL


def agent(size: Needle, plane: Plane = vertical) -> Agent:
    """Makes the demonstrator for a needle, whose arc is driven in a plane with `plane(state)`."""

    def init(key: jax.Array, state: EnvState) -> DriveScript:
        own = {"turn": jnp.zeros(()), "held": _held(state), "lead": slack.none(state)}
        own |= wrist_script.rotations(state.pose.R[0])
        script = phases.begin(DriveScript, TIMING, key, state.pose.p[0], **own)
        script = script.replace(jaws=-jnp.ones(()), jaws_from=-jnp.ones(()))
        return enter(size, script, jnp.asarray(APPROACH, jnp.int32), state, plane)

    def act(script: DriveScript, state: EnvState) -> tuple[Command, DriveScript, Command]:
        """Returns the disturbed command, the script a step later, and the command to record."""
        after = enter(size, script, _following(script, state), state, plane)
        script, s = phases.advance(script, TIMING, after, state)
        share = scripting.sloped(s)
        straight = wrist_script.straight(script, share)
        on_arc = _on_arc(size, script, share, state, plane)
        drives = script.phase == DRIVE
        tip = jax.tree.map(lambda a, b: jnp.where(drives, a, b), on_arc, straight)
        weight = jnp.asarray(DISTURBANCE)[script.phase]
        fade = jnp.where(script.phase == DESCEND, 1.0 - s, 1.0)
        lead = slack.update(script.lead, state)
        led = slack.led(lead, tip)
        rough, script, label = wrist_script.commands(script, led, weight, fade, state)
        script = script.replace(at=tip.p, R=tip.R, lead=slack.sent(lead, rough))
        return rough, script, label

    return Agent(init, act)


def enter(
    size: Needle, script: DriveScript, phase: jax.Array, state: EnvState, plane: Plane = vertical
) -> DriveScript:
    """Begins `phase`: sets its goal, rotation and duration."""
    bite, held, up = state.layout.bite, _held(state), plane(state)
    half = needles.entry_angle(size, bite)
    start = tip_of(needles.pose_on(size, bite, -half - BEFORE, up), held)
    stays = Pose(script.R, script.at)
    above = start.p + jnp.array([0.0, 0.0, HOVER])
    high = stays.p.at[2].set(jnp.maximum(stays.p[2], HIGH))
    goals = [high, above, start.p, stays.p, stays.p]
    is_free = (phase == APPROACH) | (phase == DESCEND)
    turn = needles.turn_on(size, bite, state.measurements.needle, up)
    R_goal = jnp.where(is_free, start.R, script.R)
    script = wrist_script.enter(script, TIMING, phase, goals, R_goal, turn=turn, held=held)
    sweep = jnp.abs(_end(size, state) - turn) / TURN_SPEED / script.tempo
    return script.replace(duration=jnp.where(phase == DRIVE, sweep, script.duration))


def _on_arc(
    size: Needle, script: DriveScript, share: jax.Array, state: EnvState, plane: Plane = vertical
) -> Pose:
    """Returns pose_world_tip at a fraction of the drive; it begins where the phase did."""
    bite, whole, up = state.layout.bite, _end(size, state) - script.turn, plane(state)
    first, now = (
        tip_of(needles.pose_on(size, bite, script.turn + part * whole, up), script.held)
        for part in (0.0, share)
    )
    return wrist_script.from_start(script, first, now, share)


def _end(size: Needle, state: EnvState) -> jax.Array:
    """Returns the needle's turn (rad) at the end of the drive."""
    return needles.entry_angle(size, state.layout.bite) + EMERGE / size.radius


def _held(state: EnvState) -> Pose:
    """Returns pose_tip_needle as measured."""
    return wrist_script.held(state, state.measurements.needle)


def _following(script: DriveScript, state: EnvState) -> jax.Array:
    """Returns the next phase: a needle that is not through is driven again."""
    found = state.measurements
    again = jnp.where(found.is_inside, DRIVE, RAISE)
    is_short = (script.phase >= DRIVE) & (found.emerged < task.EMERGED)
    following = jnp.where(is_short, again, jnp.minimum(script.phase + 1, HOLD))
    return following.astype(jnp.int32)


AGENT = agent(needles.CT1)
SMALL = agent(needles.SH)
