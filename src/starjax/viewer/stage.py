"""One rollout in the page's 3D: the scene, the tip's path so far, the plan ahead."""

import collections
from typing import Any

import mujoco
import numpy as np

from starjax.viewer import drawing
from starjax.viewer.frame import Frame

_APART = 0.6  # m between two rollouts
_TRAIL = 90  # moments that the tip's path stays
_WIDTH = 0.0008  # m
_TRAIL_RGB, _PLAN_RGB = (96, 125, 139), (0, 150, 136)


class Stage:
    """Draws frames of rollout number `i`, beside those before it."""

    def __init__(self, scene: Any, model: mujoco.MjModel, i: int = 0):
        root = f"/rollout{i}"
        self._root = scene.add_frame(root, show_axes=False, position=(0.0, _APART * i, 0.0))
        self._show = drawing.add(scene, model, f"{root}/geoms")
        self._tips = collections.deque[np.ndarray](maxlen=_TRAIL)
        blank = np.zeros((1, 2, 3), np.float32)
        self._trail = scene.add_line_segments(f"{root}/trail", blank, _TRAIL_RGB, thickness=_WIDTH)
        self._plan = scene.add_line_segments(f"{root}/plan", blank, _PLAN_RGB, thickness=_WIDTH)

    def clear(self) -> None:
        """Forgets the path."""
        self._tips.clear()

    def show(self, frame: Frame) -> None:
        """Draws a moment."""
        self._show(frame.qpos, frame.p_world_trocar, frame.rgb)
        self._tips.append(np.asarray(frame.p_world_tip))
        self._trail.points = _segments(np.stack(self._tips))
        here = np.asarray(frame.p_world_tip)[None]
        self._plan.points = _segments(np.concatenate([here, frame.plan]))

    def remove(self) -> None:
        """Takes all of it off the page."""
        self._root.remove()


def aim(server: Any, rollouts: int) -> None:
    """Points a new page's camera so that it sees all rollouts."""
    others = rollouts - 1
    middle = 0.5 * _APART * others
    server.initial_camera.position = (0.28 + 0.4 * others, middle - 0.22, 0.24 + 0.18 * others)
    server.initial_camera.look_at = (0.0, middle, 0.07)
    server.initial_camera.near = 0.005


def _segments(p: np.ndarray) -> np.ndarray:
    """Paths `[T, A, 3]` as segments `[K, 2, 3]`; of a single moment, a point."""
    if len(p) < 2:
        p = np.concatenate([p, p])
    return np.stack([p[:-1], p[1:]], 2).reshape(-1, 2, 3).astype(np.float32)
