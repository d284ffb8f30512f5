"""Scripted expert of needle regrasp: above the wire, along the needle's normal, close, lift, hold.

The tip's rotation is the needle's: jaws across the wire, their axis along the needle's normal, in
the posture of the jaws with less roll. The wrist's angles follow from the measured trocar. It is
disturbed on purpose, and starts over if the needle is not held.
"""

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.spatial.transform import Rotation

from starjax import rcm
from starjax.sim import ik
from starjax.sim.state import EnvState
from starjax.sim.tasks import phases, scripting
from starjax.sim.tasks.needle_regrasp import task
from starjax.sim.tasks.phases import APPROACH, DESCEND, RAISE
from starjax.types import Agent, Command, Pose

CLOSE, LIFT, HOLD = range(3, 6)
TIMING = phases.PhaseTable(
    duration=(0.5, 1.8, 0.9, 0.4, 0.9, 1.0),
    speed=(0.04, 0.03, 0.02, 1.0, 0.02, 1.0),
    jaws=(1.0, 1.0, 1.0, -1.0, -1.0, -1.0),
    tempo=(0.85, 1.2),
)
WRIST = rcm.LARGE_NEEDLE_DRIVER  # of the task's tool
DISTURBANCE = (1.0, 1.0, 0.5, 0.0, 0.2, 0.1)  # its weight in each phase
DEVIATION = (0.0012, 0.0012, 0.0012, 0.0)  # m, of the position
HOVER = 0.018  # m above the wire, along the needle's normal
ABOVE = 0.0  # m of the tip above the wire's middle
LIFT_HEIGHT = 0.027  # m
GRASP_ANGLE = float((task.FRACTION - 0.5) * np.pi)  # rad on the arc
HALF_TURN = np.diag([-1.0, -1.0, 1.0]).astype(np.float32)


@flax.struct.dataclass
class RegraspScript(phases.PhaseScript):
    """Progress of the script in one episode.

    Attributes:
      R_from, R_goal, R: `[3, 3]`, the tip's rotations at the phase's ends and now.
    """

    R_from: jax.Array
    R_goal: jax.Array
    R: jax.Array


def init(key: jax.Array, state: EnvState) -> RegraspScript:
    """Starts the script of an episode."""
    R = state.pose.R[0]
    script = phases.begin(RegraspScript, TIMING, key, state.pose.p[0], R_from=R, R_goal=R, R=R)
    return _enter(script, jnp.asarray(APPROACH, jnp.int32), state)


def _grasp(state: EnvState) -> Pose:
    """Returns pose_world_tip of the grasp, in the posture that needs less roll."""
    needle = state.measurements.pick.needle
    normal = needle.R[:, 2]
    x, z = task.wire_tangent(needle, jnp.asarray(GRASP_ANGLE)), -normal
    R = jnp.stack([x, jnp.cross(z, x), z], -1)
    p = task.wire_point(needle, jnp.asarray(GRASP_ANGLE)) + ABOVE * normal
    p_trocar = state.measured_trocar.p_world_trocar[0]
    angles = rcm.angles_through(WRIST, Pose(R, p), p_trocar)
    roll = rcm.roll_of(rcm.shaft_of(WRIST, Pose(R, p), angles).R)
    away = jnp.cos(roll - state.measured_trocar.roll_zero[0])
    return Pose(jnp.where(away < 0.0, R @ HALF_TURN, R), p)


def _enter(script: RegraspScript, phase: jax.Array, state: EnvState) -> RegraspScript:
    """Begins `phase`: sets its goal, rotation and duration."""
    grasp, tip = _grasp(state), script.at
    up = state.measurements.pick.needle.R[:, 2]
    high = state.layout.needle.p[2] + HOVER + task.pick.TIP_SPREAD
    goals = [
        tip.at[2].set(jnp.maximum(tip[2], high)),
        grasp.p + HOVER * up,
        grasp.p,
        tip,
        tip.at[2].add(LIFT_HEIGHT),
        tip,
    ]
    is_free = (phase == APPROACH) | (phase == DESCEND)
    return phases.enter(
        script,
        TIMING,
        phase,
        goals,
        attempt=script.attempt + (phase == APPROACH),
        R_from=script.R,
        R_goal=jnp.where(is_free, grasp.R, script.R),
    )


def _following(script: RegraspScript, state: EnvState) -> jax.Array:
    """Returns the next phase, the first one if the needle is not held."""
    is_lost = (script.phase >= LIFT) & ~state.measurements.pick.touch
    following = jnp.where(is_lost, RAISE, jnp.minimum(script.phase + 1, HOLD))
    return following.astype(jnp.int32)


def act(script: RegraspScript, state: EnvState) -> tuple[Command, RegraspScript, Command]:
    """Returns the disturbed command, the script a step later, and the command to record."""
    after = _enter(script, _following(script, state), state)
    script, s = phases.advance(script, TIMING, after)
    share = scripting.minimum_jerk(s)
    turn = share * ik.rotation_between(script.R_from, script.R_goal)
    noise = scripting.disturb(script.key, script.noise, state.step, jnp.array(DEVIATION))
    script = script.replace(
        at=script.start + share * (script.goal - script.start),
        R=Rotation.from_rotvec(turn).as_matrix() @ script.R_from,
        noise=noise,
    )
    weight = jnp.asarray(DISTURBANCE)[script.phase]
    moved = weight * noise[1, :3] * jnp.where(script.phase == DESCEND, 1.0 - s, 1.0)
    return _command(script, script.at + moved, state), script, _command(script, script.at, state)


def _command(script: RegraspScript, p: jax.Array, state: EnvState) -> Command:
    """Returns the command `[1]` of the script's rotation at a tip `[3]` m."""
    p_trocar: Any = state.measured_trocar.p_world_trocar[0]
    found = rcm.through(WRIST, Pose(script.R, p), p_trocar)
    pose = Pose(found.pose.R[None], found.pose.p[None])
    return Command(pose, script.jaws[None], found.wrist[None])


AGENT = Agent(init, act)
