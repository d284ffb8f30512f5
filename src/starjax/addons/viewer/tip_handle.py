"""The handle at a tip: arrows that drag it and, with a wrist, rings that turn it."""

import functools
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import jax
import numpy as np
from scipy.spatial.transform import Rotation

from starjax import rcm
from starjax.addons.viewer.handles import RELEASE_S

if TYPE_CHECKING:  # for annotations alone
    import viser

# Targets of teleoperation are roll, tip, angles; actions of `rcm6` are roll, angles, tip.
FROM_RCM6 = np.array([0, 3, 4, 5, 1, 2])
TO_RCM6 = np.array([0, 4, 5, 1, 2, 3])
_SIZE = 0.045  # m, length of the arrows


class TipHandle:
    """A handle whose pose is that of the tip of one arm.

    Without a wrist it only moves the tip. With one, the motion of the handle is one of the tip's
    pose: roll and angles follow from it and the trocar, and arrows keep the rotation.
    """

    def __init__(self, scene: "viser.SceneApi", wrist: rcm.Wrist | None = None):
        self._maps = None if wrist is None else _maps(wrist)
        self._handle = scene.add_transform_controls(
            "/hand", scale=_SIZE, disable_rotations=wrist is None, depth_test=False
        )
        self._remember()

    @property
    def is_released(self) -> bool:
        """True some time after its last motion."""
        return time.time() - self._handle.update_timestamp > RELEASE_S

    def increment(
        self, goal: np.ndarray, trocar: rcm.TrocarFrame | None, scale: float
    ) -> np.ndarray:
        """Returns the increment of a target's goal by the handle's motion since the last call.

        Args:
          goal: `[D]`, see `TeleopTarget`.
          trocar: of the arm; used with a wrist only.
          scale: motion of the tip per motion of the handle.
        """
        by, p, wxyz = np.zeros(len(goal)), self._p, self._wxyz
        self._remember()
        by[1:4] = scale * (self._p - p)
        is_still = np.array_equal(p, self._p) and np.array_equal(wxyz, self._wxyz)
        if self._maps is None or is_still:
            return by
        encode, rotation = self._maps
        turn = scale * (_rotation(self._wxyz) * _rotation(wxyz).inv()).as_rotvec()
        wanted = Rotation.from_rotvec(turn).as_matrix() @ rotation(goal, trocar)
        by = encode(wanted, goal[1:4] + by[1:4], trocar) - goal
        by[0] = np.remainder(by[0] + np.pi, 2.0 * np.pi) - np.pi  # the shorter way
        return by

    def settle(self, goal: np.ndarray, trocar: rcm.TrocarFrame | None) -> None:
        """Moves the handle to the tip of a goal."""
        if not np.array_equal(self._p, goal[1:4]):
            self._handle.position = goal[1:4]
        if self._maps is not None:
            R = Rotation.from_matrix(self._maps[1](goal, trocar))
            if not R.approx_equal(_rotation(self._wxyz), atol=1e-5):  # float32 in the maps
                self._handle.wxyz = R.as_quat(scalar_first=True)
        self._remember()

    def _remember(self) -> None:
        self._p, self._wxyz = np.array(self._handle.position), np.array(self._handle.wxyz)


def _rotation(wxyz: np.ndarray) -> Rotation:
    return Rotation.from_quat(wxyz, scalar_first=True)


@functools.lru_cache
def _maps(wrist: rcm.Wrist) -> tuple[Callable[..., np.ndarray], Callable[..., np.ndarray]]:
    """Returns (R, p, trocar) -> goal `[6]`, and (goal `[6]`, trocar) -> R_world_tip of a wrist."""
    space = rcm.rcm6(wrist)
    encode = jax.jit(lambda R, p, frame: space.encode(rcm.Pose(R, p), frame))
    decode = jax.jit(lambda action, frame: space.decode(action, frame)[0].R)

    def goal(R: np.ndarray, p: np.ndarray, trocar: rcm.TrocarFrame) -> np.ndarray:
        return np.asarray(encode(np.float32(R), np.float32(p), trocar), np.float64)[FROM_RCM6]

    def rotation(goal: np.ndarray, trocar: rcm.TrocarFrame) -> np.ndarray:
        return np.asarray(decode(np.float32(goal[TO_RCM6]), trocar), np.float64)

    return goal, rotation
