"""The trocars on the page: handles in the scene, sliders of r, theta and phi, a random one.

An operator's own trocars stay from trial to trial until a configuration of the task is selected.
"""

import secrets
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from starjax import rcm
from starjax.addons.viewer import page
from starjax.addons.viewer.handles import TrocarHandles
from starjax.rcm.trocar import Trocar
from starjax.sim import registries, sampling
from starjax.sim.task import Slot, Task

if TYPE_CHECKING:  # for annotations alone
    import viser

_MM, _DEG = 1e3, 180.0 / np.pi
_UNITS = np.array([_MM, _DEG, _DEG])
_LABELS = ("r (mm)", "θ (°)", "φ (°)")
_STEPS = (0.1, 0.5, 1.0)  # for the sliders
_spherical, _position = jax.jit(rcm.trocar_from_position), jax.jit(rcm.trocar_position)


class TrocarControls:
    """Handles and sliders of a task's trocars, which follow each other.

    Attributes:
      is_own: the operator has moved a trocar since the last `release`.
    """

    def __init__(self, server: "viser.ViserServer", task: Task):
        self._task, self._requests = task, page.UiRequests()
        self._p_world_ref = np.array([slot.p_world_ref for slot in task.slots], np.float32)
        self._handles = TrocarHandles(server.scene, task)
        gui = server.gui
        self._folders, self._sliders = [], []
        for i, slot in enumerate(task.slots):
            title = "Trocar" if task.arms == 1 else f"Trocar of arm {i}"
            folder = gui.add_folder(title)
            with folder:
                self._sliders.append(self._rows(gui, slot))
            self._folders.append(folder)
        self._button = gui.add_button("Random trocar", hint="as in the training's Eq. 19")
        self._button.on_click(lambda _: self._requests.add("random"))
        self.is_own = False

    def place(self, p_world_trocar: np.ndarray) -> None:
        """Moves everything to the trocars `[A, 3]` m of a trial's start."""
        self._handles.place(p_world_trocar)
        self._show(p_world_trocar)

    def release(self) -> None:
        """Gives up the operator's own trocars."""
        self.is_own = False

    def own(self) -> Trocar | None:
        """Returns the operator's own trocars, fields `[A]`, None without any."""
        if not self.is_own:
            return None
        return Trocar(*map(np.asarray, _spherical(self._handles.target(), self._p_world_ref)))

    def target(self) -> np.ndarray:
        """Returns the target trocars `[A, 3]` m after drags, slides and draws."""
        requested = self._requests.pop()
        if requested:
            trocar = self._drawn() if "random" in requested else self._slid()
            self._handles.place(np.asarray(_position(trocar, self._p_world_ref)))
        p = self._handles.target()
        if requested or not np.array_equal(p, self._shown):
            self.is_own = True
            self._show(p)
        return p

    def remove(self) -> None:
        """Removes handles and sliders from the page."""
        for part in (self._handles, *self._folders, self._button):
            part.remove()

    def _rows(self, gui: "viser.GuiApi", slot: Slot) -> list[Any]:
        space = registries.workspaces.get(slot.workspace)
        rows = []
        ranges = zip(_LABELS, (space.radius, space.polar, space.azimuth), _UNITS, _STEPS)
        for label, bounds, unit, step in ranges:
            # Whole steps: the page rounds a slider's values to them.
            low, high = np.floor(bounds[0] * unit / step), np.ceil(bounds[1] * unit / step)
            low, high = float(low * step), float(high * step)
            row = gui.add_slider(label, low, high, step, low)
            # `_show` moves the sliders too: only a client's move is a request.
            row.on_update(
                lambda event: self._requests.add("slide") if event.client is not None else None
            )
            rows.append(row)
        return rows

    def _slid(self) -> Trocar:
        values = np.array([[row.value for row in rows] for rows in self._sliders], np.float32)
        return Trocar(*(values / _UNITS.astype(np.float32)).T)

    def _drawn(self) -> Trocar:
        return sampling.sample_trocars(jax.random.key(secrets.randbelow(2**31)), self._task)

    def _show(self, p_world_trocar: np.ndarray) -> None:
        self._shown = np.array(p_world_trocar, np.float32)
        trocar = np.stack(_spherical(self._shown, self._p_world_ref), -1) * _UNITS
        for rows, values in zip(self._sliders, trocar):
            middle = 0.5 * (rows[2].min + rows[2].max)  # azimuths wrap around
            values[2] = middle + (values[2] - middle + 180.0) % 360.0 - 180.0
            for row, value, step in zip(rows, values, _STEPS):
                row.value = float(np.clip(round(value / step) * step, row.min, row.max))
