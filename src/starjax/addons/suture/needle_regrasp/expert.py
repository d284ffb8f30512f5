"""Scripted expert of needle regrasp: above the wire, along the needle's normal, close, lift, hold.

The tip's rotation is the needle's: jaws across the wire, their axis along the needle's normal, in
the posture of the jaws with less roll. The wrist's angles follow from the measured trocar. It is
disturbed on purpose, and starts over if the needle is not held.
"""

import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.addons.suture.needle_regrasp import task
from starjax.core.types import Agent, Command, Pose
from starjax.sim.state import EnvState
from starjax.tasks import phases, scripting, wrist_script
from starjax.tasks.phases import APPROACH, DESCEND, RAISE
from starjax.tasks.wrist_script import WRIST, WristScript

CLOSE, LIFT, HOLD = range(3, 6)
TIMING = phases.PhaseTable(
    duration=(0.5, 1.7, 0.9, 0.0, 0.9, 1.0),
    speed=(0.04, 0.032, 0.02, 1.0, 0.022, 1.0),
    jaws=(1.0, 1.0, 1.0, -1.0, -1.0, -1.0),
    tempo=(0.85, 1.2),
)
DISTURBANCE = (1.0, 1.0, 0.5, 0.0, 0.2, 0.1)  # its weight in each phase
HOVER = 0.018  # m above the wire, along the needle's normal
ABOVE = 0.0  # m of the tip above the wire's middle
LIFT_HEIGHT = 0.027  # m
TOP = 0.012  # m above that, to which it rises on in a hold
GRASP_ANGLE = float((task.FRACTION - 0.5) * np.pi)  # rad on the arc
HALF_TURN = np.diag([-1.0, -1.0, 1.0]).astype(np.float32)


def init(key: jax.Array, state: EnvState) -> WristScript:
    """Starts the script of an episode."""
    own = wrist_script.rotations(state.pose.R[0])
    script = phases.begin(WristScript, TIMING, key, state.pose.p[0], **own)
    return enter(script, jnp.asarray(APPROACH, jnp.int32), state)


def _grasp(state: EnvState) -> Pose:
    """Returns pose_world_tip of the grasp, in the posture that needs less roll."""
    needle = state.measurements.pick.needle
    normal = _normal(needle)
    x, z = task.wire_tangent(needle, jnp.asarray(GRASP_ANGLE)), -normal
    R = jnp.stack([x, jnp.cross(z, x), z], -1)
    p = task.wire_point(needle, jnp.asarray(GRASP_ANGLE)) + ABOVE * normal
    p_trocar = state.measured_trocar.p_world_trocar[0]
    angles = rcm.angles_through(WRIST, Pose(R, p), p_trocar)
    roll = rcm.roll_of(rcm.shaft_of(WRIST, Pose(R, p), angles).R)
    away = jnp.cos(roll - state.measured_trocar.roll_zero[0])
    return Pose(jnp.where(away < 0.0, R @ HALF_TURN, R), p)


def _normal(needle: Pose) -> jax.Array:
    """Returns the needle's normal that points up: a needle may lie on its other side."""
    return needle.R[:, 2] * jnp.where(needle.R[2, 2] < 0.0, -1.0, 1.0)


def enter(script: WristScript, phase: jax.Array, state: EnvState) -> WristScript:
    """Begins `phase`: sets its goal, rotation and duration."""
    grasp, tip = _grasp(state), script.at
    up = _normal(state.measurements.pick.needle)
    high = state.layout.needle.p[2] + HOVER + task.pick.TIP_SPREAD
    top = state.layout.needle.p[2] + LIFT_HEIGHT + TOP
    goals = [
        tip.at[2].set(jnp.maximum(tip[2], high)),
        grasp.p + HOVER * up,
        grasp.p,
        tip,
        tip.at[2].add(LIFT_HEIGHT),
        tip.at[2].set(jnp.clip(top, tip[2], tip[2] + phases.RISE)),
    ]
    is_free = (phase == APPROACH) | (phase == DESCEND)
    R_goal = jnp.where(is_free, grasp.R, script.R)
    return wrist_script.enter(script, TIMING, phase, goals, R_goal)


def _following(script: WristScript, state: EnvState) -> jax.Array:
    """Returns the next phase, the first one if the needle is not held."""
    is_lost = (script.phase >= LIFT) & ~state.measurements.pick.touch
    following = jnp.where(is_lost, RAISE, jnp.minimum(script.phase + 1, HOLD))
    return following.astype(jnp.int32)


def act(script: WristScript, state: EnvState) -> tuple[Command, WristScript, Command]:
    """Returns the disturbed command, the script a step later, and the command to record."""
    after = enter(script, _following(script, state), state)
    script, s = phases.advance(script, TIMING, after, state)
    share = scripting.sloped(s)
    weight = jnp.asarray(DISTURBANCE)[script.phase]
    fade = jnp.where(script.phase == DESCEND, 1.0 - s, 1.0)
    return wrist_script.commands(script, wrist_script.straight(script, share), weight, fade, state)


AGENT = Agent(init, act)
