"""Scripted expert of needle hand-over with wrists: jaws that stand upright, at every trocar alike.

The tips lean towards their sides by one angle, and turn about their own x axis until the jaws open
horizontally: flat on the wire of a level needle at any yaw. Neither position nor rotation of
a tip depends on its trocar. Otherwise it is the expert of straight tools.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.spatial.transform import Rotation

from starjax import rcm
from starjax.core.types import Command, Pose
from starjax.sim import ik
from starjax.sim.state import EnvState
from starjax.sim.task import CONTROL_HZ
from starjax.tasks import handover, scripting
from starjax.tasks.needle_handover import expert
from starjax.tasks.wrist_script import WRIST

LEAN = 0.5  # rad from straight down, as shafts through the middle trocars at the hand-over
AXES = np.array([[np.sin(LEAN), 0, -np.cos(LEAN)], [-np.sin(LEAN), 0, -np.cos(LEAN)]], np.float32)
BEND = 1.0  # s in which the straight wrists of the start come to their lean
# Gentler and slower than a straight tool: in C MuJoCo pads that are fully closed, or carry a needle
# along their opening direction twice as fast, squeeze the wire out.
CARRY = 2.4  # s of the way to the hand-over
GRIP = -0.6  # opening of jaws that hold
ABOVE = 0.0  # m of the tip above the wire: these pads end nearer to it than those of the grasper


def upright(R: jax.Array) -> jax.Array:
    """Turns tips `[..., 3, 3]` about their own x axis until their jaws open horizontally."""
    angle = -jnp.arctan(R[..., 2, 1] / R[..., 2, 2])  # R_z,y cos + R_z,z sin = 0
    return R @ Rotation.from_rotvec(angle[..., None] * jnp.eye(3)[0]).as_matrix()


def _command(roll: jax.Array, p: jax.Array, jaws: jax.Array, state: EnvState) -> Command:
    """Returns the command of rolls `[2]` rad about the leaning axes, tips `[2, 3]` m and jaws."""
    straight = scripting.command(roll, p, jaws, state)
    if state.wrist is None:
        return straight
    zero = state.measured_trocar.roll_zero
    # Same lean at every trocar
    R = upright(rcm.rotation_from_axis_roll(jnp.asarray(AXES), roll + zero))
    share = scripting.sloped(jnp.clip(state.step / (BEND * CONTROL_HZ), 0.0, 1.0))
    # A wrist cannot jump: from the straight start to the lean along the geodesic.
    turn = share * jax.vmap(ik.rotation_between)(straight.pose.R, R)
    R = Rotation.from_rotvec(turn).as_matrix() @ straight.pose.R
    # Shaft and angles
    feasible = rcm.through(WRIST, Pose(R, p), state.measured_trocar.p_world_trocar)
    return Command(feasible.pose, jaws, feasible.wrist)


PLAY = expert.PLAY._replace(
    duration=np.where(np.array(expert.PHASES) == "carry", CARRY, expert.DURATION),
    jaws=np.where(expert.PLAY.jaws < 0, GRIP, expert.PLAY.jaws),
    goals=functools.partial(expert.goals, ABOVE),
    command=_command,
)
AGENT = handover.agent(PLAY)
