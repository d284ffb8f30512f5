"""Motion of one arm that holds an instrument with a wrist, for a control period.

The arm carries the shaft; the wrist's angles follow from the tip's pose and the point at which the
shaft passes the trocar. Tip, rotation and point move towards the command within the limits of
`sim.control`; interpolated angles would move the tip off its way.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.spatial.transform import Rotation

from starjax import rcm
from starjax.core.types import Pose
from starjax.sim import control, ik
from starjax.sim import scene as scenes

# Size of the reference's velocity: tip (3) m/s, turn (3) rad/s, its shaft at the trocar (3) m/s.
VELOCITY = 9
# In its cannula a wrist is straight: the dVRK engages instruments with angles up to 15 degrees
# (tool-engage-position of its descriptions). Its limits grow to the full ones on the first 10 mm
# (chosen) of the wrist below the least depth.
ENGAGED = float(np.deg2rad(15.0))
OPENING = 0.010  # m


class Reference:
    """Names of a reference's parts in its velocity `[9]`."""

    TIP, TURN, POINT = slice(0, 3), slice(3, 6), slice(6, 9)


def tip_of(bound: scenes.BoundArm, shaft: Pose, q: jax.Array) -> Pose:
    """Returns pose_world_tip of the shaft and all joints `[J]` of an arm with a wrist."""
    assert bound.tool.wrist is not None
    return rcm.tip_of(bound.tool.wrist, shaft, q[bound.joints :])


def shaft_of(bound: scenes.BoundArm, tip: Pose, angles: jax.Array | None) -> Pose:
    """Returns pose_world_shaft of a commanded tip; without angles the wrist is straight."""
    assert bound.tool.wrist is not None
    return rcm.shaft_of(bound.tool.wrist, tip, jnp.zeros(2) if angles is None else angles)


def limits_at(wrist: rcm.Wrist, depth: jax.Array) -> rcm.Wrist:
    """Returns the wrist with its limits at a depth (m) of its pitch axis."""
    # In the cannula a wrist cannot bend: its limits open as it leaves.
    share = jnp.clip((depth - rcm.MIN_DEPTH) / OPENING, 0.0, 1.0)
    pitch, yaw = (ENGAGED + share * (limit - ENGAGED) for limit in (wrist.pitch, wrist.yaw))
    return wrist._replace(pitch=pitch, yaw=yaw)


def toward(
    present: Pose,
    here: jax.Array,
    velocity: jax.Array,
    target: Pose,
    there: jax.Array,
    period: float,
) -> tuple[Pose, jax.Array, jax.Array]:
    """Returns the reference after `period` s, single-sample.

    Args:
      present: reference pose of the tip now. here: `[3]` m, the shaft's point at the trocar.
      velocity: `[VELOCITY]`, of the reference.
      target: the commanded pose. there: `[3]` m, its shaft's point at the trocar.

    Returns:
      the next pose of the tip, its shaft's point `[3]` m, and the velocity `[VELOCITY]`.
    """
    step, fraction = control.step_tip(present.p, target.p, velocity[Reference.TIP], period)
    shift, point, is_slowed = control.step_point(
        here, there, fraction, velocity[Reference.POINT], period
    )
    # The rotation is the tip's fraction of its own way on, too, or slower within its limits.
    way = ik.rotation_between(present.R, target.R)  # rad about a fixed axis: the shortest turn
    turn = fraction * way
    slower = control.bounded_step(
        way,
        velocity[Reference.TURN] * period,
        control.MAX_SPIN * period,
        control.MAX_SPIN_ACCELERATION * period**2,
    )
    is_slower = jnp.sum(slower**2) < jnp.sum(turn**2)  # the rotation may lag behind the tip
    turn = jnp.where(is_slower, slower, turn)
    R = Rotation.from_rotvec(turn).as_matrix() @ present.R
    is_there = jnp.all(step == target.p - present.p) & (fraction == 1.0) & ~is_slower & ~is_slowed
    pose = jax.tree.map(lambda a, b: jnp.where(is_there, a, b), target, Pose(R, present.p + step))
    return pose, point, jnp.concatenate([step, turn, shift]) / period


def carried(wrist: rcm.Wrist, tip: Pose, point: jax.Array) -> tuple[Pose, jax.Array]:
    """Returns the shaft through a point `[3]` m for a tip pose, and the angles `[2]` rad.

    Within the limits the tip is kept exactly; see `rcm.through` for others.
    """
    # m, nearly: of a straight wrist
    depth = jnp.linalg.norm(tip.p - point) - wrist.clevis - wrist.jaws
    found = rcm.through(limits_at(wrist, depth), tip, point)
    return rcm.shaft_of(wrist, found.pose, found.wrist), found.wrist
