"""Trocars of episodes on the host by `rcm.trocar_from_poses`, one program whatever their length."""

from typing import Any

import jax
import numpy as np

from starjax import rcm

ROWS = 1024  # poses that an estimate is made of, at most
_estimate = jax.jit(rcm.trocar_from_poses)


def subsample(x: Any) -> np.ndarray:
    """Returns at most `ROWS` evenly spaced rows of `[T, ...]`."""
    return np.asarray(x)[np.linspace(0, len(x) - 1, min(len(x), ROWS)).astype(int)]


def estimate(R: Any, p: Any) -> rcm.TrocarEstimate:
    """Estimates the trocars of A arms from their motion.

    Args:
      R: `[T, A, 3, 3]` R_world_tip.
      p: `[T, A, 3]` m.

    Returns:
      Numpy fields `[A, ...]`.
    """

    def rows(x: Any) -> np.ndarray:
        some = subsample(x)
        padded = np.full((ROWS, *some.shape[1:]), np.nan, np.float32)
        padded[: len(some)] = some
        return padded.swapaxes(0, 1)

    return jax.device_get(_estimate(rcm.Pose(*map(jax.device_put, (rows(R), rows(p))))))
