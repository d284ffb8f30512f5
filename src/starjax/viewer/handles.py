"""Handles of trocars: arrows in the 3D that one drags, held within what the arms can reach."""

import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.sim import registries
from starjax.sim.tasks.base import Slot, Task

SCALE = 0.055  # m, length of the arrows
_LET_GO_S = 0.4  # without a move, until a handle counts as let go


class TrocarHandles:
    """A handle for each trocar of a task."""

    def __init__(self, scene: Any, task: Task):
        self._slots = task.slots
        self._handles = [
            scene.add_transform_controls(
                f"/trocar{i}", scale=SCALE, disable_rotations=True, depth_test=False
            )
            for i in range(task.arms)
        ]
        self._wanted = np.zeros((task.arms, 3), np.float32)
        self._seen = self._wanted.copy()

    def place(self, p_world_trocar: np.ndarray) -> None:
        """Puts the handles where the trocars `[A, 3]` m are, as at the start of a trial."""
        self._wanted = np.array(p_world_trocar, np.float32)
        self._settle()

    def wanted(self) -> np.ndarray:
        """Where the trocars are to be, `[A, 3]` m; a handle that was let go returns there."""
        now = np.array([list(handle.position) for handle in self._handles], np.float32)
        for i in np.flatnonzero((now != self._seen).any(-1)):
            self._wanted[i] = within(self._slots[i], now[i])
        self._seen = now
        last = max(handle.update_timestamp for handle in self._handles)
        if (now != self._wanted).any() and time.time() - last > _LET_GO_S:
            self._settle()
        return self._wanted

    def remove(self) -> None:
        """Takes them off the page."""
        for handle in self._handles:
            handle.remove()

    def _settle(self) -> None:
        for handle, p in zip(self._handles, self._wanted, strict=True):
            handle.position = p
        self._seen = np.array([handle.position for handle in self._handles], np.float32)


def within(slot: Slot, p_world_trocar: np.ndarray) -> np.ndarray:
    """The place `[3]` m nearest in radius and angles for which the slot's mounts were found."""
    space = registries.workspaces.get(slot.workspace)
    ranges = np.array([space.radius, space.polar, space.azimuth], np.float32)
    return np.asarray(_clipped(p_world_trocar, np.array(slot.p_world_ref, np.float32), ranges))


@jax.jit
def _clipped(p: jax.Array, p_world_ref: jax.Array, ranges: jax.Array) -> jax.Array:
    found = rcm.trocar_from_position(p, p_world_ref)
    low, high = ranges[2]
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    off = found.azimuth - middle
    off = off - 2.0 * jnp.pi * jnp.round(off / (2.0 * jnp.pi))
    trocar = rcm.Trocar(
        jnp.clip(found.radius, *ranges[0]),
        jnp.clip(found.polar, *ranges[1]),
        middle + jnp.clip(off, -half, half),
    )
    return rcm.trocar_position(trocar, p_world_ref)
