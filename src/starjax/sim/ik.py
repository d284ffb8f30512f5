"""Forward and inverse kinematics of a serial arm (Eq. 17), single-sample."""

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from starjax.core.types import Pose
from starjax.sim import linear

# Weight of rotation errors against position errors, m/rad.
ROTATION_WEIGHT = 0.2
# Damping of the least squares; small, because mounts keep singular values >= 0.05 (a test).
DAMPING = 1e-3
# No joint moves further than this in one iteration (rad, m).
MAX_STEP = 0.35
# Joint targets stay this far inside the limits (rad, m).
LIMIT_MARGIN = 0.01
POSE_SIZE = 6  # degrees of freedom of a pose: joints beyond six are redundant


@flax.struct.dataclass
class Chain:
    """A chain of J hinges about, and slides along, local z axes; numpy constants.

    `chain.replace(p_base=...)` makes it stand elsewhere, also where that is traced.

    Attributes:
      p_base, R_base: `[3]` m, `[3, 3]`: the frame that the first body stands in.
      offsets: `[J, 3]` m and `rotations`: `[J, 3, 3]`: each joint's frame in the one before it.
      p_tip, R_tip: the tip in the last joint's frame.
      limits: `[J, 2]` rad (m of a slide), infinite for an unlimited joint.
      slides: True for each of the J joints that is a slide.
    """

    p_base: np.ndarray
    R_base: np.ndarray
    offsets: np.ndarray
    rotations: np.ndarray
    p_tip: np.ndarray
    R_tip: np.ndarray
    limits: np.ndarray
    slides: tuple[bool, ...] = flax.struct.field(pytree_node=False)


def forward(chain: Chain, q: jax.Array) -> tuple[Pose, jax.Array, jax.Array]:
    """Computes the tip's pose for the configuration `q` `[J]` rad (m of a slide).

    Returns:
      pose_world_tip; the joints' origins `[J, 3]` m; their axes `[J, 3]`, both in the world.
    """
    p, R = jnp.asarray(chain.p_base), jnp.asarray(chain.R_base)
    origins, axes = [], []
    for i, is_slide in enumerate(chain.slides):
        p = p + R @ chain.offsets[i]  # in the frame before the joint turns
        R = R @ chain.rotations[i]
        if is_slide:
            p = p + q[i] * R[:, 2]
        origins.append(p)
        axes.append(R[:, 2])
        if not is_slide:
            c, s = jnp.cos(q[i]), jnp.sin(q[i])
            turned = [c * R[:, 0] + s * R[:, 1], c * R[:, 1] - s * R[:, 0], R[:, 2]]
            R = jnp.stack(turned, axis=1)
    return Pose(R @ chain.R_tip, p + R @ chain.p_tip), jnp.stack(origins), jnp.stack(axes)


def jacobian(chain: Chain, q: jax.Array, rotation_weight: float) -> jax.Array:
    """Computes the Jacobian `[6, J]` of the tip, its rotation (rad) times `rotation_weight` m."""
    pose, origins, axes = forward(chain, q)
    return _jacobian(chain, pose, origins, axes, rotation_weight)


def solve(
    chain: Chain,
    target: Pose,
    q: jax.Array,
    iterations: int,
    home: jax.Array | None = None,
    gain: float = 0.0,
) -> tuple[jax.Array, jax.Array]:
    """Solves Eq. 17 by damped least squares from `q` towards `target`.

    Redundant joints return towards `home` in every iteration except the last, which keeps the pose
    exact. Without it they would drift.

    Args:
      target: pose_world_tip, single.
      q: `[J]` rad (m of a slide), where to start: the present configuration.
      iterations: 3-4 from a neighbouring pose, 30 from afar, 40 for the free joints to settle.
      home: `[J]`, needed with a `gain`.
      gain: fraction of the way home that redundant joints take per iteration: 0.1 to 0.3, or 0.

    Returns:
      `[J]` within the limits; the residual in m, rotation weighed by `ROTATION_WEIGHT`.
    """
    low = chain.limits[:, 0] + LIMIT_MARGIN
    high = chain.limits[:, 1] - LIMIT_MARGIN
    is_redundant = home is not None and gain > 0 and len(chain.slides) > POSE_SIZE

    def iterate(i, q):
        pose, origins, axes = forward(chain, q)
        J = _jacobian(chain, pose, origins, axes, ROTATION_WEIGHT)
        missing = _error(pose, target)  # [6]: m, and rad times ROTATION_WEIGHT
        # Null-space term: dq = free + J+ (missing - J free) reaches the same pose, with the part of
        # `free` in the null space of J.
        if is_redundant:
            free = jnp.where(i + 1 < iterations, gain, 0.0) * (home - q)
            dq = free + _least_squares(J, missing - J @ free)
        else:
            dq = _least_squares(J, missing)
        # Shortened as a whole: the direction stays, while the linearisation holds only nearby.
        dq = dq * jnp.minimum(1.0, MAX_STEP / jnp.maximum(jnp.max(jnp.abs(dq)), 1e-9))
        # Joints at their limit stay there; the next iteration moves the others.
        return jnp.clip(q + dq, low, high)

    q = jax.lax.fori_loop(0, iterations, iterate, q)
    return q, residual(chain, target, q)


def residual(chain: Chain, target: Pose, q: jax.Array) -> jax.Array:
    """Returns the distance (m) of configuration `q` from `target`, rotation weighed."""
    pose, _, _ = forward(chain, q)
    return jnp.linalg.norm(_error(pose, target))


def _jacobian(
    chain: Chain, pose: Pose, origins: jax.Array, axes: jax.Array, rotation_weight: float
) -> jax.Array:
    # Hinge: v = z x (p_tip - p_joint), w = z
    moves, turns = jnp.cross(axes, pose.p - origins), axes
    if any(chain.slides):
        slides = np.array(chain.slides)[:, None]
        # Slide: v = z, w = 0
        moves, turns = jnp.where(slides, axes, moves), jnp.where(slides, 0.0, axes)
    return jnp.concatenate([moves.T, rotation_weight * turns.T])


def _least_squares(J: jax.Array, missing: jax.Array) -> jax.Array:
    """Solves J dq = missing `[6]`, damped, by the smaller of two equal normal equations."""
    joints = J.shape[1]
    if joints < POSE_SIZE:
        return linear.solve_positive(J.T @ J + DAMPING**2 * jnp.eye(joints), J.T @ missing)
    # J' (J J' + damping^2)^-1: the damping bounds dq near a singular configuration.
    return J.T @ linear.solve_positive(J @ J.T + DAMPING**2 * jnp.eye(POSE_SIZE), missing)


def rotation_between(R: jax.Array, R_target: jax.Array) -> jax.Array:
    """Returns the rotation vector `[3]` rad, in the world, from `R` to `R_target`."""
    E = R_target @ R.T  # in the world: the Jacobian's rotations are, too
    # v = sin(angle) axis, and trace E = 1 + 2 cos(angle).
    v = 0.5 * jnp.stack([E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1]])
    sine_sq = jnp.sum(v * v)
    is_small = sine_sq < 1e-12
    sine = jnp.sqrt(jnp.where(is_small, 1.0, sine_sq))
    angle = jnp.arctan2(sine, 0.5 * (jnp.trace(E) - 1.0))
    turn = v * jnp.where(is_small, 1.0, angle / sine)
    # At half a turn v vanishes, but E = 2 a a' - 1: any non-zero column of E + 1 is along the axis.
    column = (E + jnp.eye(3))[:, jnp.argmax(jnp.diagonal(E))]
    half = jnp.pi * column / jnp.maximum(jnp.linalg.norm(column), 1.0)
    return jnp.where(is_small & (jnp.trace(E) < 1.0), half, turn)


def _error(pose: Pose, target: Pose) -> jax.Array:
    """Returns the difference `[6]` m from `pose` to `target`, rotation weighed."""
    turn = rotation_between(pose.R, target.R)
    return jnp.concatenate([target.p - pose.p, ROTATION_WEIGHT * turn])
