"""Arrows in the 3D view that drag the trocars, limited to the reach of the arms."""

import time
from typing import TYPE_CHECKING

import numpy as np

from starjax.sim import registries, trocar_region
from starjax.sim.task import Slot, Task

if TYPE_CHECKING:  # for annotations alone
    import viser

_SCALE = 0.055  # m, length of the arrows
RELEASE_S = 0.4  # time without a move after which a handle counts as released


class TrocarHandles:
    """The handles of a task's trocars, one per arm."""

    def __init__(self, scene: "viser.SceneApi", task: Task):
        self._slots = task.slots
        self._handles = [
            scene.add_transform_controls(
                f"/trocar{i}", scale=_SCALE, disable_rotations=True, depth_test=False
            )
            for i in range(task.arms)
        ]
        self._target = np.zeros((task.arms, 3), np.float32)
        self._before = self._target.copy()

    def place(self, p_world_trocar: np.ndarray) -> None:
        """Moves the handles to the trocars `[A, 3]` m, as at the start of a trial."""
        self._target = np.array(p_world_trocar, np.float32)
        self._settle()

    def target(self) -> np.ndarray:
        """Returns the target trocars `[A, 3]` m; released handles snap to them."""
        p = np.array([list(handle.position) for handle in self._handles], np.float32)
        for i in np.flatnonzero((p != self._before).any(-1)):
            self._target[i] = within(self._slots[i], p[i])
        self._before = p
        last = max(handle.update_timestamp for handle in self._handles)
        if (p != self._target).any() and time.time() - last > RELEASE_S:
            self._settle()
        return self._target

    def remove(self) -> None:
        """Removes the handles from the page."""
        for handle in self._handles:
            handle.remove()

    def _settle(self) -> None:
        for handle, p in zip(self._handles, self._target, strict=True):
            handle.position = p
        self._before = np.array([handle.position for handle in self._handles], np.float32)


def within(slot: Slot, p_world_trocar: np.ndarray) -> np.ndarray:
    """Returns the position `[3]` m with radius and angles clipped to the slot's workspace."""
    space = registries.workspaces.get(slot.workspace)
    reference = np.array(slot.p_world_ref, np.float32)
    region = (space.radius, space.polar, space.azimuth)
    clipped = trocar_region.clipped(region, np.asarray(p_world_trocar) - reference)
    return (reference + clipped).astype(np.float32)
