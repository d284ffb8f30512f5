"""The thread's drawn links: geoms `thread0`, `thread1`, .. of the model, placed at its points.

A thread has no joints. Wherever coordinates of an image are kept, those of its points follow qpos.
"""

from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from starjax.core.types import Array

GEOM = "thread"


def ids(m: mujoco.MjModel) -> np.ndarray:
    """Returns the geoms `[N - 1]` of the links, empty for a model without a thread."""
    found = [m.geom(g) for g in range(m.ngeom) if m.geom(g).name.startswith(GEOM)]
    return np.array([g.id for g in sorted(found, key=lambda g: int(g.name[len(GEOM) :]))], int)


def split(m: mujoco.MjModel, coordinates: Array) -> tuple[Any, Any]:
    """Returns qpos `[Q]` and the thread's points `[N, 3]` m, N = 0 without a thread."""
    if len(coordinates) == m.nq:
        return coordinates, np.zeros((0, 3), np.float32)
    return coordinates[: m.nq], coordinates[m.nq :].reshape(-1, 3)


def poses(points: Array) -> tuple[Any, Any]:
    """Returns the links' centres `[N - 1, 3]` m and rotations `[N - 1, 3, 3]`, z along the link."""
    xp = np if isinstance(points, np.ndarray) else jnp
    along = points[1:] - points[:-1]
    z = along / xp.maximum(xp.linalg.norm(along, axis=-1, keepdims=True), 1e-9)
    # Any x across z, from the axis along which z has its smallest component.
    x = xp.cross(z, xp.eye(3)[xp.argmin(xp.abs(z), -1)])
    x = x / xp.maximum(xp.linalg.norm(x, axis=-1, keepdims=True), 1e-9)
    return 0.5 * (points[1:] + points[:-1]), xp.stack([x, xp.cross(z, x), z], -1)


def placed(m: mujoco.MjModel, data: mjx.Data, points: Array) -> Any:
    """Returns MJX data with the links at the points `[N, 3]` m."""
    if not len(points):
        return data
    rows, (p, R) = ids(m), poses(points)
    return data.replace(
        geom_xpos=data.geom_xpos.at[rows].set(p), geom_xmat=data.geom_xmat.at[rows].set(R)
    )


def place(m: mujoco.MjModel, data: mujoco.MjData, points: np.ndarray) -> None:
    """Moves the links of C data to the points `[N, 3]` m."""
    if not len(points):
        return
    p, R = poses(np.asarray(points))
    data.geom_xpos[ids(m)], data.geom_xmat[ids(m)] = p, R.reshape(-1, 9)
