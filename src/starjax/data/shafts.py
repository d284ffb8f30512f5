"""Trocars of episodes on the host by `rcm.trocar_from_poses`, one program whatever their length."""

from typing import Any

import jax
import numpy as np

from starjax import rcm
from starjax.core.types import Array

ROWS = 1024  # poses that an estimate is made of, at most
_estimate = jax.jit(rcm.trocar_from_poses)
_shaft_of = jax.jit(rcm.shaft_of, static_argnums=0)


def subsample(x: Array) -> np.ndarray:
    """Returns at most `ROWS` evenly spaced rows of `[T, ...]`."""
    return np.asarray(x)[np.linspace(0, len(x) - 1, min(len(x), ROWS)).astype(int)]


def estimate(R: Array, p: Array) -> rcm.TrocarEstimate:
    """Estimates the trocars of A arms from their motion.

    Args:
      R: `[T, A, 3, 3]` R_world_tip.
      p: `[T, A, 3]` m.

    Returns:
      Numpy fields `[A, ...]`.
    """

    def rows(x: Array) -> np.ndarray:
        some = subsample(x)
        padded = np.full((ROWS, *some.shape[1:]), np.nan, np.float32)
        padded[: len(some)] = some
        return padded.swapaxes(0, 1)

    return jax.device_get(_estimate(rcm.Pose(*map(jax.device_put, (rows(R), rows(p))))))


def of_wrist(R: Any, p: Any, wrist: rcm.Wrist, angles: np.ndarray) -> rcm.Pose:
    """Returns the shafts `[T]` of tips with a wrist, in numpy.

    Args:
      R: `[T, 3, 3]` R_world_tip. p: `[T, 3]` m.
      wrist: sizes.
      angles: `[T, 2]` rad, pitch and yaw.
    """
    length = len(p)
    rows = -length % ROWS  # repetitions of the last one, for few programs
    R, p, angles = (
        np.concatenate([x, np.repeat(x[-1:], rows, axis=0)]).astype(np.float32)
        for x in (R, p, angles)
    )
    shaft = jax.device_get(_shaft_of(wrist, rcm.Pose(R, p), angles))
    return jax.tree.map(lambda x: x[:length].astype(np.float64), shaft)
