"""Poses as rows of numbers outside of starjax: x y z in m, quaternion x y z w, gripper."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from starjax import rcm
from starjax.core.errors import UsageError

COLUMNS = 8  # for an arm
# Numbers of an arm's action: a row, or the action of a space and the gripper.
ACTIONS = {"pose": COLUMNS, "rcm4": rcm.ACTION_SPACES["rcm4"].dim + 1}
_SHORTEST = 0.5  # norm of a quaternion: below, its direction is noise


def pack(p: ArrayLike, R: ArrayLike, gripper: ArrayLike) -> np.ndarray:
    """Packs poses `[..., A]` to rows `[..., 8 A]`."""
    p, R, gripper = (np.asarray(x) for x in (p, R, gripper))
    xyzw = Rotation.from_matrix(R.reshape(-1, 3, 3)).as_quat().reshape(*R.shape[:-2], 4)
    rows = np.concatenate([p, xyzw, gripper[..., None]], -1)
    return rows.reshape(*rows.shape[:-2], -1)


def unpack(argument: str, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns positions `[..., A, 3]`, rotations `[..., A, 3, 3]` and grippers `[..., A]`.

    Args:
      argument: name of the rows, for errors.
      rows: `[..., 8 A]`.

    Raises:
      UsageError: a value is not finite, or a quaternion far from a unit one.
    """
    if not np.isfinite(rows).all():
        raise UsageError(argument, "finite values", "NaN or inf")
    arms = np.asarray(rows, np.float64).reshape(*rows.shape[:-1], -1, COLUMNS)
    p, xyzw, gripper = arms[..., :3], arms[..., 3:7], arms[..., 7]
    norm = np.linalg.norm(xyzw, axis=-1)
    if norm.min() < _SHORTEST:
        raise UsageError(argument, "unit quaternions x y z w", f"one of norm {norm.min():.3g}")
    R = Rotation.from_quat(xyzw.reshape(-1, 4)).as_matrix().reshape(*p.shape, 3)
    return p, R, gripper


def without_flips(rows: np.ndarray, previous: np.ndarray) -> np.ndarray:
    """Returns rows `[..., 8 A]` with each quaternion's sign the nearer one to `previous`.

    q and -q are one rotation.
    """
    arms = rows.reshape(*rows.shape[:-1], -1, COLUMNS).copy()
    before = previous.reshape(arms.shape)
    dot = np.sum(arms[..., 3:7] * before[..., 3:7], -1, keepdims=True)
    arms[..., 3:7] *= np.where(dot < 0, -1.0, 1.0)
    return arms.reshape(rows.shape)
