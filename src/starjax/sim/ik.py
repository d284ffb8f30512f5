"""Forward and inverse kinematics of a serial arm (Eq. 17), single-sample, in plain JAX."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from starjax.sim import linear
from starjax.types import Pose

# Rotation errors weigh this many metres a radian against position errors.
ROTATION_WEIGHT = 0.2
# Damping of the least squares; small, because the reachable set keeps singular values >= 0.065.
DAMPING = 1e-3
# No joint moves further than this in one iteration (rad).
MAX_STEP = 0.35
# Joint targets stay this far inside the limits (rad).
LIMIT_MARGIN = 0.01


class Chain(NamedTuple):
    """A chain of hinges about their local z axes, numpy constants.

    Attributes:
      p_base, R_base: `[3]` m, `[3, 3]`: the fixed frame that the first body stands in.
      offsets: `[J, 3]` m and `rotations`: `[J, 3, 3]`: each body's pose in its parent's frame.
      p_tip, R_tip: the tip in the last body's frame.
      limits: `[J, 2]` rad.
    """

    p_base: np.ndarray
    R_base: np.ndarray
    offsets: np.ndarray
    rotations: np.ndarray
    p_tip: np.ndarray
    R_tip: np.ndarray
    limits: np.ndarray


def chain_of(m: mujoco.MjModel, first: str, site: str) -> Chain:
    """The chain from body `first` down to `site`, read off a compiled model.

    Raises:
      ValueError: `first` is not above the site.
    """
    data = mujoco.MjData(m)
    mujoco.mj_kinematics(m, data)
    body = int(m.site(site).bodyid[0])
    p_tip, R_tip = np.array(m.site(site).pos), _matrix(m.site(site).quat)
    while body and m.body_jntnum[body] == 0:  # tool bodies fixed to the last link
        R = _matrix(m.body_quat[body])
        p_tip, R_tip = m.body_pos[body] + R @ p_tip, R @ R_tip
        body = int(m.body_parentid[body])
    bodies = [body]
    while m.body(bodies[-1]).name != first:
        if not bodies[-1]:  # the world, which is its own parent
            raise ValueError(f"first: expected a body above the site {site}, got {first!r}")
        bodies.append(int(m.body_parentid[bodies[-1]]))
    bodies = bodies[::-1]
    root = int(m.body_parentid[bodies[0]])
    return Chain(
        p_base=_float32(data.xpos[root]),
        R_base=_float32(data.xmat[root].reshape(3, 3)),
        offsets=_float32(m.body_pos[bodies]),
        rotations=_float32([_matrix(m.body_quat[b]) for b in bodies]),
        p_tip=_float32(p_tip),
        R_tip=_float32(R_tip),
        limits=_float32([m.jnt_range[m.body_jntadr[b]] for b in bodies]),
    )


def forward(chain: Chain, q: jax.Array) -> tuple[Pose, jax.Array, jax.Array]:
    """Tip pose of configuration `q` `[J]` rad.

    Returns:
      pose_world_tip; the joints' origins `[J, 3]` m; their axes `[J, 3]`, both in the world.
    """
    p, R = jnp.asarray(chain.p_base), jnp.asarray(chain.R_base)
    origins, axes = [], []
    for i in range(chain.offsets.shape[0]):
        p = p + R @ chain.offsets[i]
        R = R @ chain.rotations[i]
        origins.append(p)
        axes.append(R[:, 2])
        c, s = jnp.cos(q[i]), jnp.sin(q[i])
        R = jnp.stack([c * R[:, 0] + s * R[:, 1], c * R[:, 1] - s * R[:, 0], R[:, 2]], axis=1)
    return Pose(R @ chain.R_tip, p + R @ chain.p_tip), jnp.stack(origins), jnp.stack(axes)


def solve(chain: Chain, target: Pose, q: jax.Array, iterations: int) -> tuple[jax.Array, jax.Array]:
    """Damped least squares from `q` towards `target` (Eq. 17).

    Args:
      target: pose_world_tip wanted, single.
      q: `[J]` rad, where to start: the present configuration.
      iterations: 3-4 from a neighbouring pose, 30 from afar.

    Returns:
      `[J]` rad within the limits; the residual in m, rotation weighed by `ROTATION_WEIGHT`.
    """
    low = chain.limits[:, 0] + LIMIT_MARGIN
    high = chain.limits[:, 1] - LIMIT_MARGIN

    def iterate(_, q):
        pose, origins, axes = forward(chain, q)
        J = jnp.concatenate([jnp.cross(axes, pose.p - origins).T, ROTATION_WEIGHT * axes.T])
        H = J @ J.T + DAMPING**2 * jnp.eye(6)
        dq = J.T @ linear.solve_positive(H, _error(pose, target))
        dq = dq * jnp.minimum(1.0, MAX_STEP / jnp.maximum(jnp.max(jnp.abs(dq)), 1e-9))
        return jnp.clip(q + dq, low, high)

    q = jax.lax.fori_loop(0, iterations, iterate, q)
    return q, residual(chain, target, q)


def _rotation_between(R: jax.Array, R_target: jax.Array) -> jax.Array:
    """Rotation vector `[3]` rad, in the world, that takes `R` to `R_target`."""
    E = R_target @ R.T
    v = 0.5 * jnp.stack([E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1]])
    sine_sq = jnp.sum(v * v)
    is_small = sine_sq < 1e-12
    sine = jnp.sqrt(jnp.where(is_small, 1.0, sine_sq))
    angle = jnp.arctan2(sine, 0.5 * (jnp.trace(E) - 1.0))
    turn = v * jnp.where(is_small, 1.0, angle / sine)
    # Half a turn about a is 2 a a' - 1.
    column = (E + jnp.eye(3))[:, jnp.argmax(jnp.diagonal(E))]
    half = jnp.pi * column / jnp.maximum(jnp.linalg.norm(column), 1.0)
    return jnp.where(is_small & (jnp.trace(E) < 1.0), half, turn)


def residual(chain: Chain, target: Pose, q: jax.Array) -> jax.Array:
    """Distance (m) of configuration `q` from `target`, rotation weighed by `ROTATION_WEIGHT`."""
    pose, _, _ = forward(chain, q)
    return jnp.linalg.norm(_error(pose, target))


def _error(pose: Pose, target: Pose) -> jax.Array:
    """`[6]` m: what is missing from `pose` to `target`, rotation weighed."""
    turn = _rotation_between(pose.R, target.R)
    return jnp.concatenate([target.p - pose.p, ROTATION_WEIGHT * turn])


def _float32(x: object) -> np.ndarray:
    return np.asarray(x, np.float32)


def _matrix(wxyz: np.ndarray) -> np.ndarray:
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, np.asarray(wxyz, np.float64))
    return out.reshape(3, 3)
