"""Free bodies in generalised coordinates, and their contacts."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.spatial.transform import Rotation

from starjax.core.types import Pose
from starjax.sim.task import Contacts


def free_pose(qpos: jax.Array, start: int) -> Pose:
    """Returns the world pose of the free body with 7 coordinates from `start` of `qpos` `[Q]`."""
    coords = qpos[start : start + 7]
    w, x, y, z = coords[3:] / jnp.linalg.norm(coords[3:])  # integration lets the length drift
    rows = (
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    )
    return Pose(jnp.stack([jnp.stack(row) for row in rows]), coords[:3])


def upright_coords(pose: Pose) -> jax.Array:
    """Returns the 7 coordinates of a free body that is turned about the world's z axis only."""
    # Half the yaw: quaternion (cos, 0, 0, sin)
    half, zero = 0.5 * jnp.arctan2(pose.R[1, 0], pose.R[0, 0]), jnp.zeros(())
    return jnp.concatenate([pose.p, jnp.stack([jnp.cos(half), zero, zero, jnp.sin(half)])])


def free_coords(pose: Pose) -> jax.Array:
    """Returns the 7 coordinates of a free body."""
    wxyz = jnp.roll(Rotation.from_matrix(pose.R).as_quat(), 1)
    return jnp.concatenate([pose.p, wxyz])


def is_sound(
    qpos: jax.Array, qvel: jax.Array, start: int, dof: int, max_speed: float, max_distance: float
) -> jax.Array:
    """Returns True while a free body is slower (m/s), and nearer (m), than anything physical."""
    speed = jnp.max(jnp.abs(qvel[dof : dof + 3]))
    away = jnp.max(jnp.abs(qpos[start : start + 3]))
    return (speed < max_speed) & (away < max_distance)


def touch(contacts: Contacts, *groups: np.ndarray) -> jax.Array:
    """Returns True if one contact overlaps geoms of every group of ids."""
    # [C] each
    hits = [jnp.any(contacts.geom[..., None] == jnp.asarray(ids), axis=(-2, -1)) for ids in groups]
    return jnp.any(functools.reduce(jnp.logical_and, hits, contacts.dist < 0))
