"""Low-level controller between two commands: bounded speed and acceleration about the trocar.

A policy's next plan rarely begins where the last one ended, so a far command is approached at a
bounded pace. On the way the tool's axis keeps to the trocar as well as both ends do: a command on
the RCM manifold is reached along the manifold; one that misses the trocar by d is reached through
poses that miss it by a fraction of d. The axis passes the trocar no faster than the tip may move.

Servos yield under load. At the tip they must; at the trocar 0.1 mm matters. A feedback turns the
tool about its tip until the measured axis passes the trocar where the reference does.
"""

import jax
import jax.numpy as jnp

from starjax import rcm
from starjax.core.types import Pose

# Limits of the tip (m/s, m/s^2) and of the roll about the axis (rad/s, rad/s^2). They are equal for
# every arm, for equal motions under one policy; `Arm.max_speed` also bounds the joints. The FR5's
# torque suffices for twice the tip's acceleration. Jumps between plans of a failing policy set the
# limit: with 1.8 m/s^2 the axis missed the trocar by 0.14 mm (99th percentile of five such trials),
# with 0.9 by 0.08.
MAX_SPEED = 0.2
MAX_ACCELERATION = 0.9
MAX_SPIN = 4.0
MAX_SPIN_ACCELERATION = 40.0
# Fraction of the axis's deviation at the trocar that each control period corrects: a constant
# load's deviation shrinks to a third in 0.17 s. Deviations of single periods, which no feedback can
# foresee, grow by a twentieth; with twice the gain by an eighth.
HOLD_GAIN = 0.2
# m of depth up to which the gain grows with the square: near the trocar a small correction is a
# large turn of the joints, and with the full gain the arm oscillates.
FIRM_DEPTH = 0.03
MAX_CORRECTION = 5e-3  # m at the trocar: a larger yield of servos is not elastic
MAX_TURN = 0.05  # rad, of the tool for it: near the trocar turning moves nothing there
# m, largest deviation that one period corrects: beyond it servos are saturated, and the integral
# would wind up
MAX_DEVIATION = 1e-3
# m from the tip to the trocar within which the axis keeps its direction: there it is ill-defined.
# Well below the least depth of an action (`rcm.MIN_DEPTH`).
NO_DIRECTION = 1e-3
VELOCITY = 7  # size of a reference's velocity


def toward(
    present: Pose, velocity: jax.Array, target: Pose, p_trocar: jax.Array, period: float
) -> tuple[Pose, jax.Array]:
    """Returns the reference pose after `period` s, single-sample.

    Args:
      present: reference pose of the tip now.
      velocity: `[7]`, of the reference: tip (3) m/s, roll rad/s, its axis at the trocar (3) m/s.
      target: the commanded pose.
      p_trocar: `[3]` m.

    Returns:
      the next reference pose, equal to `target` if that is near enough; its velocity `[7]`.
    """
    # 1. The tip, on a straight line; 2. the axis's point at the trocar, by the same fraction; 3.
    # the roll.
    step, fraction = step_tip(present.p, target.p, velocity[:3], period)
    p = present.p + step

    z_present, z_target = present.R[:, 2], target.R[:, 2]
    here, there = nearest(present, p_trocar), nearest(target, p_trocar)
    shift, through, is_slowed = step_point(here, there, fraction, velocity[4:VELOCITY], period)
    axis = p - through  # from the trocar's side to the tip
    axis = axis * jnp.where(axis @ z_present < 0, -1.0, 1.0)  # the tip is above the trocar
    axis = jnp.where(jnp.linalg.norm(axis) < NO_DIRECTION, z_present, axis)
    z = axis / jnp.maximum(jnp.linalg.norm(axis), 1e-6)
    # The rest of the rotation, once the axes are aligned, is a roll about the axis.
    # The smallest rotation between the axes adds no roll; the rest is the twist to make.
    carried = rcm.rotation_align(z_present, z_target) @ present.R
    # In the plane of both
    twist = jnp.arctan2(carried[:, 1] @ target.R[:, 0], carried[:, 0] @ target.R[:, 0])
    spin = bounded_step(
        twist[None], velocity[3:4] * period, MAX_SPIN * period, MAX_SPIN_ACCELERATION * period**2
    )
    R = rcm.rotation_align(z_present, z) @ present.R @ rcm.rotation_z(spin[0])

    # To the bit: a reference that has arrived is the command itself, without rounding.
    is_there = jnp.all(step == target.p - present.p) & (spin[0] == twist) & ~is_slowed
    pose = jax.tree.map(lambda a, b: jnp.where(is_there, a, b), target, Pose(R, p))
    return pose, jnp.concatenate([step, spin, shift]) / period


def step_tip(
    p: jax.Array, target: jax.Array, velocity: jax.Array, period: float
) -> tuple[jax.Array, jax.Array]:
    """Returns the tip's displacement `[3]` m in one period, and its fraction of the way."""
    step = bounded_step(
        target - p, velocity * period, MAX_SPEED * period, MAX_ACCELERATION * period**2
    )
    length = jnp.sum((target - p) ** 2)  # its square
    fraction = jnp.sum(step * (target - p)) / jnp.where(length > 0, length, 1.0)
    return step, jnp.where(length > 0, jnp.clip(fraction, 0.0, 1.0), 1.0)


def step_point(
    here: jax.Array, there: jax.Array, fraction: jax.Array, velocity: jax.Array, period: float
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Moves the axis's point at the trocar by the tip's fraction of its own way.

    It moves slower if that would exceed the tip's limits there.

    Returns:
      its displacement `[3]` m, its next position `[3]` m, and True if it is slower.
    """
    shift, change = fraction * (there - here), MAX_ACCELERATION * period**2
    slower = bounded_step(there - here, velocity * period, MAX_SPEED * period, change)
    is_slowed = jnp.sum(slower**2) < jnp.sum(shift**2)  # never on the manifold, where both are 0
    shift = jnp.where(is_slowed, slower, shift)
    through = jnp.where(is_slowed, here + slower, (1.0 - fraction) * here + fraction * there)
    return shift, through, is_slowed


def correct(
    correction: jax.Array, measured: Pose, reference: Pose, p_trocar: jax.Array
) -> jax.Array:
    """Integrates the measured deviation into the axis's correction `[3]` m at the trocar."""
    deviation = nearest(measured, p_trocar) - nearest(reference, p_trocar)  # m, across the axis
    far = jnp.maximum(jnp.linalg.norm(deviation), MAX_DEVIATION)
    lever = jnp.abs((reference.p - p_trocar) @ reference.R[:, 2])  # m, tip to trocar along the axis
    gain = HOLD_GAIN * jnp.minimum(1.0, lever / FIRM_DEPTH) ** 2
    # An integral: a constant load leaves no deviation.
    correction = correction - gain * deviation * (MAX_DEVIATION / far)
    largest = jnp.minimum(MAX_CORRECTION, MAX_TURN * lever)  # m: small angles near the trocar
    return correction * jnp.minimum(1.0, largest / jnp.maximum(jnp.linalg.norm(correction), 1e-9))


def corrected(pose: Pose, p_trocar: jax.Array, correction: jax.Array) -> Pose:
    """Returns the pose turned about its tip by `correction` `[3]` m of its axis at the trocar."""
    z = pose.R[:, 2]
    depth = (pose.p - p_trocar) @ z
    correction = jnp.where(depth < 0, -correction, correction)  # sign for a tip above the trocar
    lever = jnp.maximum(jnp.abs(depth), rcm.MIN_DEPTH)
    # The tip stays: only the axis moves at the trocar.
    return Pose(rcm.rotation_align(z, lever * z - correction) @ pose.R, pose.p)


def bounded_step(
    way: jax.Array, last: jax.Array, largest: float, change: jax.Array | float
) -> jax.Array:
    """Returns the displacement in one period towards `way`, after the `last` one.

    It is at most `largest` long, differs from the last by at most `change`, and can stop in time.
    """
    square = jnp.sum(way**2)
    length = jnp.sqrt(jnp.where(square > 0, square, 1.0))
    # Largest first step s that stops within `length` when each next one is `change` shorter:
    # s (s + change) / (2 change) = length.
    can_stop = 0.5 * (jnp.sqrt(change**2 + 8.0 * change * length) - change)
    target = way * jnp.minimum(1.0, jnp.minimum(largest, can_stop) / length)  # never past its end
    bend = target - last
    square = jnp.sum(bend**2)
    size = jnp.sqrt(jnp.where(square > 0, square, 1.0))
    # A ball of radius `change` about the last step: acceleration is bounded in every direction
    # alike.
    return jnp.where(size <= change, target, last + bend * (change / size))


def nearest(pose: Pose, p_trocar: jax.Array) -> jax.Array:
    """Returns the point `[3]` of the tool's axis nearest to the trocar."""
    z = pose.R[:, 2]
    return pose.p + ((p_trocar - pose.p) @ z) * z
