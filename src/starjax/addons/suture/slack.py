"""Commands that lead a tip which stays behind them, as one does whose cables are slack.

The command goes as far beyond the script's pose as the tip stayed behind the last command. Unlike
an integral of the error this is bounded by the slack.
"""

import math

import flax.struct
import jax
import jax.numpy as jnp
from jax.scipy.spatial.transform import Rotation

from starjax.core.types import Command, Pose
from starjax.sim import ik
from starjax.sim.state import EnvState

TRACKED = math.radians(0.7)  # rad; servos without slack stay this near to their commands
GAIN = 0.3  # fraction of a change that a lead takes up per control step


@flax.struct.dataclass
class Lead:
    """Lead of one tip.

    Attributes:
      sent: pose_world_tip of the last command.
      ahead: `[6]` rotation (rad) and position (m) of the command from the script's pose.
    """

    sent: Pose
    ahead: jax.Array


def none(state: EnvState) -> Lead:
    """Returns the lead of the first tool before the first command."""
    return Lead(_first(state.pose), jnp.zeros(6))


def update(lead: Lead, state: EnvState) -> Lead:
    """Returns the lead after a look at where the tip is."""
    tip = _first(state.pose)
    turn = ik.rotation_between(tip.R, lead.sent.R)
    behind = jnp.concatenate([turn, lead.sent.p - tip.p])
    behind = jnp.where(jnp.linalg.norm(turn) > TRACKED, behind, 0.0)
    return lead.replace(ahead=lead.ahead + GAIN * (behind - lead.ahead))


def led(lead: Lead, tip: Pose) -> Pose:
    """Returns the pose to command for a script's tip; the same without a lead."""
    turn = Rotation.from_rotvec(lead.ahead[:3]).as_matrix()
    R = jnp.where((lead.ahead != 0.0).any(), turn @ tip.R, tip.R)
    return Pose(R, tip.p + lead.ahead[3:])


def sent(lead: Lead, command: Command) -> Lead:
    """Returns the lead after a command `[1]`."""
    return lead.replace(sent=_first(command.pose))


def _first(pose: Pose) -> Pose:
    return jax.tree.map(lambda leaf: leaf[0], pose)
