"""The low-level controller between two commands: bounded speed and acceleration, about the trocar.

A command far from where the tool is (a policy's next plan rarely begins where the last one ended)
is approached, not leapt at. On the way the tool's axis keeps to the trocar as well as both ends do:
a command on the RCM manifold is reached along the manifold, one that misses the trocar by d misses
it by a share of d, and its axis passes the trocar no faster than the tip may move.

Servos give way under load, at the tip as they must, but at the trocar 0.1 mm is much. There the
measured axis is brought back to where the reference has it, by turning the tool about its tip.
"""

import jax
import jax.numpy as jnp

from starjax import rcm
from starjax.types import Pose

# Of the tip (m/s, m/s^2) and of the roll about the axis (rad/s, rad/s^2). The same for every arm,
# so that a policy moves alike with each; `Arm.max_speed` bounds the joints besides. Found with the
# first arm: its torque can follow them, and twice such a tip. A policy that is lost jumps from plan
# to plan, and servos do not answer a jerk alike: with 1.8 m/s^2 the axis missed the trocar by
# 0.14 mm then (99th percentile of five such trials), with 0.9 by 0.08.
MAX_SPEED = 0.2
MAX_ACCELERATION = 0.9
MAX_SPIN = 4.0
MAX_SPIN_ACCELERATION = 40.0
# Share of the axis's deviation at the trocar that is taken back each control period: that under a
# load that stays shrinks to a third in 0.17 s. Deviations of single periods, which no feedback can
# foresee, grow by a twentieth; with twice the gain by an eighth.
HOLD_GAIN = 0.2
# m of depth up to which that share grows, with the square: a small turn about a tip near the trocar
# is a large one of the joints, and with the whole share the arm swings there for ever.
FIRM_DEPTH = 0.03
MAX_CORRECTION = 5e-3  # m at the trocar: servos that give way by more are not just elastic
MAX_TURN = 0.05  # rad, of the tool for it: near the trocar turning moves nothing there
# m, of a deviation that one period answers: a larger one is of servos that have reached their
# limits, where more would be asked of them for ever
MAX_DEVIATION = 1e-3
# m between tip and trocar within which the axis stays as it is, having no certain direction: well
# below the least depth that actions may ask for (`rcm.MIN_DEPTH`)
NO_DIRECTION = 1e-3


def toward(
    present: Pose, velocity: jax.Array, wanted: Pose, p_trocar: jax.Array, period: float
) -> tuple[Pose, jax.Array]:
    """The pose to be at after `period` s, single-sample.

    Args:
      present: reference pose of the tip now.
      velocity: `[7]`, of the reference: tip (3) m/s, roll rad/s, its axis at the trocar (3) m/s.
      wanted: the commanded pose.
      p_trocar: `[3]` m.

    Returns:
      the next reference pose, equal to `wanted` if that is near enough; its velocity `[7]`.
    """
    speed = MAX_SPEED * period
    step = _step(wanted.p - present.p, velocity[:3] * period, speed, MAX_ACCELERATION * period**2)
    p = present.p + step
    length = jnp.sum((wanted.p - present.p) ** 2)
    share = jnp.sum(step * (wanted.p - present.p)) / jnp.where(length > 0, length, 1.0)
    share = jnp.where(length > 0, jnp.clip(share, 0.0, 1.0), 1.0)

    z_present, z_wanted = present.R[:, 2], wanted.R[:, 2]
    here, there = _nearest(present, p_trocar), _nearest(wanted, p_trocar)
    shift, most = share * (there - here), MAX_ACCELERATION * period**2
    slower = _step(there - here, velocity[4:] * period, speed, most)
    is_slowed = jnp.sum(slower**2) < jnp.sum(shift**2)  # never on the manifold, where both are 0
    shift = jnp.where(is_slowed, slower, shift)
    through = jnp.where(is_slowed, here + slower, (1.0 - share) * here + share * there)
    axis = p - through
    axis = axis * jnp.where(axis @ z_present < 0, -1.0, 1.0)  # the tip is above the trocar
    axis = jnp.where(jnp.linalg.norm(axis) < NO_DIRECTION, z_present, axis)
    z = axis / jnp.maximum(jnp.linalg.norm(axis), 1e-6)
    carried = rcm.rotation_align(z_present, z_wanted) @ present.R
    twist = jnp.arctan2(carried[:, 1] @ wanted.R[:, 0], carried[:, 0] @ wanted.R[:, 0])
    spin = _step(
        twist[None], velocity[3:4] * period, MAX_SPIN * period, MAX_SPIN_ACCELERATION * period**2
    )
    R = rcm.rotation_align(z_present, z) @ present.R @ rcm.rotation_z(spin[0])

    is_there = jnp.all(step == wanted.p - present.p) & (spin[0] == twist) & ~is_slowed
    pose = jax.tree.map(lambda a, b: jnp.where(is_there, a, b), wanted, Pose(R, p))
    return pose, jnp.concatenate([step, spin, shift]) / period


def correct(
    correction: jax.Array, measured: Pose, reference: Pose, p_trocar: jax.Array
) -> jax.Array:
    """The next correction `[3]` m of the axis at the trocar, from the measured deviation."""
    deviation = _nearest(measured, p_trocar) - _nearest(reference, p_trocar)
    far = jnp.maximum(jnp.linalg.norm(deviation), MAX_DEVIATION)
    lever = jnp.abs((reference.p - p_trocar) @ reference.R[:, 2])
    gain = HOLD_GAIN * jnp.minimum(1.0, lever / FIRM_DEPTH) ** 2
    correction = correction - gain * deviation * (MAX_DEVIATION / far)
    most = jnp.minimum(MAX_CORRECTION, MAX_TURN * lever)
    return correction * jnp.minimum(1.0, most / jnp.maximum(jnp.linalg.norm(correction), 1e-9))


def corrected(pose: Pose, p_trocar: jax.Array, correction: jax.Array) -> Pose:
    """The pose turned about its tip until its axis passes `correction` `[3]` m further on."""
    z = pose.R[:, 2]
    depth = (pose.p - p_trocar) @ z
    correction = jnp.where(depth < 0, -correction, correction)  # of a tip above the trocar
    lever = jnp.maximum(jnp.abs(depth), rcm.MIN_DEPTH)
    return Pose(rcm.rotation_align(z, lever * z - correction) @ pose.R, pose.p)


def _step(way: jax.Array, last: jax.Array, most: float, change: jax.Array | float) -> jax.Array:
    """Displacement in one period towards `way`, given the `last` one.

    No longer than `most`, no more than `change` from the last, and short enough to stop in time.
    """
    square = jnp.sum(way**2)
    length = jnp.sqrt(jnp.where(square > 0, square, 1.0))
    can_stop = 0.5 * (jnp.sqrt(change**2 + 8.0 * change * length) - change)
    target = way * jnp.minimum(1.0, jnp.minimum(most, can_stop) / length)
    bend = target - last
    square = jnp.sum(bend**2)
    size = jnp.sqrt(jnp.where(square > 0, square, 1.0))
    return jnp.where(size <= change, target, last + bend * (change / size))


def _nearest(pose: Pose, p_trocar: jax.Array) -> jax.Array:
    """The point `[3]` of the tool's axis nearest to the trocar."""
    z = pose.R[:, 2]
    return pose.p + ((p_trocar - pose.p) @ z) * z
