"""Scripts of one arm with a wrist: tip poses on straight ways and on a needle's arc.

The wrist's angles follow from the measured trocar.
"""

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
from jax.scipy.spatial.transform import Rotation

from starjax import rcm
from starjax.core.types import ArrayTree, Command, Pose
from starjax.sim import ik
from starjax.sim.state import EnvState
from starjax.tasks import phases, scripting

WRIST = rcm.LARGE_NEEDLE_DRIVER  # wrist of the tasks' tool
DEVIATION = (0.0012, 0.0012, 0.0012, 0.0)  # m, of the disturbed position


@flax.struct.dataclass
class WristScript(phases.PhaseScript):
    """Progress of a script in one episode.

    Attributes:
      R_from, R_goal, R: `[3, 3]`, the tip's rotations at the phase's ends and now.
    """

    R_from: jax.Array
    R_goal: jax.Array
    R: jax.Array


def rotations(R: jax.Array) -> dict[str, jax.Array]:
    """Returns the fields of `WristScript` before the first phase, of the tip's rotation."""
    return {"R_from": R, "R_goal": R, "R": R}


def enter(
    script: Any,
    timing: phases.PhaseTable,
    phase: jax.Array,
    goals: list[jax.Array],
    R_goal: jax.Array,
    **own: ArrayTree,
) -> Any:
    """Returns the script at the start of `phase`, see `phases.enter`; `R_goal` is for its end.

    An attempt begins with each approach.
    """
    attempt = script.attempt + (phase == phases.APPROACH)
    rotation = {"R_from": script.R, "R_goal": R_goal}
    return phases.enter(script, timing, phase, goals, attempt=attempt, **rotation, **own)


def held(state: EnvState, needle: Pose) -> Pose:
    """Returns pose_tip_needle as measured."""
    tip = jax.tree.map(lambda leaf: leaf[0], state.pose)
    # T_tip_needle = T_world_tip^-1 T_world_needle
    return Pose(tip.R.T @ needle.R, tip.R.T @ (needle.p - tip.p))


def tip_of(needle: Pose, held: Pose) -> Pose:
    """Returns pose_world_tip of a needle's pose and its pose_tip_needle."""
    R = needle.R @ held.R.T
    return Pose(R, needle.p - R @ held.p)  # T_world_tip = T_world_needle T_tip_needle^-1


def straight(script: WristScript, share: jax.Array) -> Pose:
    """Returns pose_world_tip at a fraction of the straight way to the phase's goal."""
    turn = share * ik.rotation_between(script.R_from, script.R_goal)  # geodesic: constant axis
    return Pose(
        Rotation.from_rotvec(turn).as_matrix() @ script.R_from,
        script.start + share * (script.goal - script.start),
    )


def from_start(script: WristScript, first: Pose, now: Pose, share: jax.Array) -> Pose:
    """Returns `now` of a way from `first`, moved by a share of the gap to the phase's start."""
    # The gap between the arc's start and where the tool is vanishes on the way, without a jump.
    left = (1.0 - share) * ik.rotation_between(first.R, script.R_from)
    R = Rotation.from_rotvec(left).as_matrix() @ now.R
    return Pose(R, now.p + (1.0 - share) * (script.start - first.p))


def off(tip: Pose, by: jax.Array) -> Pose:
    """Returns pose_world_tip moved along and turned about its own axes by `[6]` m and rad."""
    return Pose(tip.R @ Rotation.from_rotvec(by[3:]).as_matrix(), tip.p + tip.R @ by[:3])


def commands(
    script: Any,
    tip: Pose,
    weight: jax.Array,
    fade: jax.Array | float,
    state: EnvState,
    miss: jax.Array | None = None,
) -> tuple[Command, Any, Command]:
    """Returns the disturbed command, the script at `tip`, and the command to record.

    Args:
      weight, fade: factors of the disturbance.
      miss: `[6]` m and rad by which the disturbed tip is `off`; None for none.
    """
    noise = scripting.disturb(script.key, script.noise, state.step, jnp.array(DEVIATION))
    script = script.replace(at=tip.p, R=tip.R, noise=noise)
    moved = tip._replace(p=tip.p + weight * noise[1, :3] * fade)
    moved = moved if miss is None else off(moved, miss)
    return _command(script, moved, state), script, _command(script, tip, state)


def _command(script: WristScript, tip: Pose, state: EnvState) -> Command:
    """Returns the command `[1]` of a tip's pose, with the script's jaws."""
    p_trocar: Any = state.measured_trocar.p_world_trocar[0]
    # The shaft through the trocar, and the wrist's angles
    found = rcm.through(WRIST, tip, p_trocar)
    pose = Pose(found.pose.R[None], found.pose.p[None])
    return Command(pose, script.jaws[None], found.wrist[None])
