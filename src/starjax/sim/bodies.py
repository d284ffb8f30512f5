"""Free bodies in generalised coordinates."""

import jax
import jax.numpy as jnp

from starjax.types import Pose


def free_pose(qpos: jax.Array, start: int) -> Pose:
    """Pose in the world of the free body whose 7 coordinates begin at `start` of `qpos` `[Q]`."""
    coords = qpos[start : start + 7]
    w, x, y, z = coords[3:] / jnp.linalg.norm(coords[3:])
    rows = (
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    )
    return Pose(jnp.stack([jnp.stack(row) for row in rows]), coords[:3])
