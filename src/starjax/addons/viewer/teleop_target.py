"""The target of an operator: a point of the RCM manifold that handle, keys and device move.

A target has roll and tip, the coordinates of action space `rcm4`, and with a wrist pitch and yaw as
well, those of `rcm6`. The shaft follows from them and therefore always passes the trocar. Plain
functions on a few numbers, 30 times a second.
"""

import queue
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from starjax import rcm
from starjax.addons.viewer import page
from starjax.addons.viewer.devices import Device, DeviceLost, Reading
from starjax.addons.viewer.tip_handle import TipHandle
from starjax.sim import registries
from starjax.sim.task import Slot

if TYPE_CHECKING:  # for annotations alone
    import viser

SPEED = 0.05  # m/s at full deflection of a device
SPIN = 1.5  # rad/s at full deflection
SMOOTHING_S = 0.1  # time constant that removes key steps and tremor from the commands
MARGIN = 0.01  # m about the workspace's tips
KEY_STEP = 0.0015  # m per key press at scale 1; holding a key repeats it
KEY_TURN = 0.05  # rad per key press
# key -> (label, increment: roll, right, away, up)
_MOVES = {
    "arrowright": ("to the right", (0, 1, 0, 0)),
    "arrowleft": ("to the left", (0, -1, 0, 0)),
    "arrowup": ("away from you", (0, 0, 1, 0)),
    "arrowdown": ("towards you", (0, 0, -1, 0)),
    "pageup": ("up", (0, 0, 0, 1)),
    "pagedown": ("down", (0, 0, 0, -1)),
    "Q": ("roll left", (1, 0, 0, 0)),
    "E": ("roll right", (-1, 0, 0, 0)),
}
# The same with a wrist, whose increments are of pitch and yaw.
_BENDS = {
    "I": ("pitch up", (1, 0)),
    "K": ("pitch down", (-1, 0)),
    "J": ("yaw left", (0, 1)),
    "L": ("yaw right", (0, -1)),
}
_BEND_HELP = " I, K (pitch) and J, L (yaw) bend the wrist; the rings at the tip turn it."
_HELP = (
    "Drag the arrows at the tip, or press arrows, Page Up and Page Down, Q and E (roll), "
    "G (jaws), C (clutch)."
)


class TeleopTarget(NamedTuple):
    """Target of one arm.

    Attributes:
      goal: `[D]` roll (rad) and tip (m, world frame) after all increments, D = 4; with a wrist also
        pitch and yaw (rad), D = 6.
      action: `[D]` the same, smoothed: the command.
      gripper: -1 squeezes, +1 is fully open.
    """

    goal: np.ndarray
    action: np.ndarray
    gripper: float = 1.0


class Bounds(NamedTuple):
    """Limits of a target.

    Attributes:
      low: `[D]` roll (rad), tip (m), angles (rad).
      high: `[D]` likewise.
    """

    low: np.ndarray
    high: np.ndarray


def bounds(slot: Slot, tip: np.ndarray, wrist: rcm.Wrist | None = None) -> Bounds:
    """Returns the range of a slot's arm, widened to include the initial tip `[3]` m."""
    space = registries.workspaces.get(slot.workspace)
    low, high = np.minimum(space.low, tip) - MARGIN, np.maximum(space.high, tip) + MARGIN
    low[2] = min(space.low[2], tip[2])  # no margin below, towards the table
    bend = () if wrist is None else (wrist.pitch, wrist.yaw)
    return Bounds(
        np.array([space.rolls[0], *low, *(-limit for limit in bend)]),
        np.array([space.rolls[1], *high, *bend]),
    )


def at_rest(action: np.ndarray, gripper: float) -> TeleopTarget:
    """Makes a target that holds an action `[D]`."""
    return TeleopTarget(np.array(action), np.array(action), gripper)


def moved(target: TeleopTarget, by: np.ndarray, within: Bounds) -> TeleopTarget:
    """Adds an increment `[D]` (rad, m) within bounds."""
    return target._replace(goal=np.clip(target.goal + by, within.low, within.high))


def toggle_jaws(target: TeleopTarget) -> TeleopTarget:
    """Opens or closes the jaws."""
    return target._replace(gripper=-1.0 if target.gripper > 0 else 1.0)


def smoothed(target: TeleopTarget, period: float) -> TeleopTarget:
    """Moves the action towards the goal for one period (s)."""
    fraction = 1.0 - np.exp(-period / SMOOTHING_S)
    return target._replace(action=target.action + fraction * (target.goal - target.action))


def increment(deflection: np.ndarray, axes: np.ndarray, scale: float, period: float) -> np.ndarray:
    """Returns the increment of a device held at a deflection for one period.

    Args:
      deflection: `[4]` in [-1, 1]: roll, right, away, up.
      axes: `[3, 3]`, see `view_axes`.
      scale: factor of the motion.
      period: s.

    Returns:
      `[4]` in rad and m in the world frame.
    """
    tip = SPEED * (axes @ deflection[1:])
    return scale * period * np.array([SPIN * deflection[0], *tip])


def view_axes(R_world_cam: np.ndarray) -> np.ndarray:
    """Returns right, away and up of a camera's image as columns `[3, 3]` in the world frame."""
    right = np.array([*R_world_cam[:2, 0], 0.0])
    length = np.linalg.norm(right)
    right = right / length if length > 1e-6 else np.array([0.0, 1.0, 0.0])
    up = np.array([0.0, 0.0, 1.0])
    return np.stack([right, np.cross(up, right), up], axis=1)


class Pilot:
    """Reader of handle, keys and device.

    Attributes:
      targets: one per arm.
      has_moved: true after the first motion since `rest`.
    """

    def __init__(
        self,
        server: "viser.ViserServer",
        arms: int,
        axes: np.ndarray,
        device: Device | None,
        wrist: rcm.Wrist | None = None,
    ):
        has_wrist = wrist is not None
        self._size = 6 if has_wrist else 4
        self._server, self._axes, self._device = server, axes, device
        self._buttons = (False, False)
        self._presses: queue.SimpleQueue[tuple[np.ndarray, bool]] = queue.SimpleQueue()
        gui = server.gui
        gui.add_markdown(_HELP + _BEND_HELP * has_wrist)
        names = tuple(str(i) for i in range(arms))
        self._arm = gui.add_dropdown("Arm", names, visible=arms > 1)
        self._clutch = gui.add_checkbox("Clutch", True, hint="C: off, the hand moves freely")
        self._scale = gui.add_slider("Scale", 0.1, 2.0, 0.1, 1.0, hint="tool over hand")
        self._handle = TipHandle(server.scene, wrist)

        def bind(key: str, label: str, by: tuple[int, ...], toggles: bool = False) -> None:
            press = (np.array([*by, 0, 0][: self._size]), toggles)
            page.add_command(gui, label, key, lambda: self._presses.put(press))

        for key, (label, by) in _MOVES.items():
            bind(key, label.capitalize(), by)
        for key, (label, bend) in _BENDS.items() if has_wrist else ():
            bind(key, label.capitalize(), (0, 0, 0, 0, *bend))
        bind("G", "Open or close the jaws", (0, 0, 0, 0), toggles=True)
        page.add_command(gui, "Clutch", "C", self._toggle_clutch)

    def rest(
        self,
        actions: np.ndarray,
        openings: np.ndarray,
        limits: list[Bounds],
        trocars: Sequence[rcm.TrocarFrame] = (),
    ) -> None:
        """Holds actions `[A, D]` and openings `[A]`, and forgets pending keys.

        Args:
          actions: `[A, D]`, see `TeleopTarget`.
          openings: `[A]` of the jaws.
          limits: one per arm.
          trocars: one per arm; needed with a wrist only.
        """
        self.targets = [at_rest(a, float(o)) for a, o in zip(actions, openings, strict=True)]
        self._limits, self._trocars, self.has_moved = limits, trocars or [None] * len(limits), False
        while not self._presses.empty():
            self._presses.get()
        self._settle()

    def read(self, period: float) -> tuple[np.ndarray, np.ndarray]:
        """Advances by one period (s); returns actions `[A, D]` and openings `[A]`."""
        arm = int(self._arm.value)
        by, toggles = self._input(period)
        if self._clutch.value and by.any():
            self.targets[arm] = moved(self.targets[arm], by, self._limits[arm])
            self.has_moved = True
        if toggles:
            self.targets[arm] = toggle_jaws(self.targets[arm])
            self.has_moved = True
        self.targets = [smoothed(target, period) for target in self.targets]
        if self._handle.is_released:
            self._settle()
        return (
            np.stack([target.action for target in self.targets]),
            np.array([target.gripper for target in self.targets]),
        )

    def _input(self, period: float) -> tuple[np.ndarray, bool]:
        """Returns the increment `[D]` (rad, m in the world frame) and a toggle of the jaws."""
        arm, toggles, scale = int(self._arm.value), False, float(self._scale.value)
        by = self._handle.increment(self.targets[arm].goal, self._trocars[arm], scale)
        steps = scale * np.array([KEY_TURN, KEY_STEP, KEY_STEP, KEY_STEP])
        while not self._presses.empty():
            press, is_toggle = self._presses.get()
            by[:4] += steps * np.array([press[0], *(self._axes @ press[1:4])])
            by[4:] += scale * KEY_TURN * press[4:]
            toggles ^= is_toggle
        if reading := self._reading():
            by[:4] += increment(reading.deflection, self._axes, scale, period)
            by[4:] += scale * period * SPIN * np.array(reading.bend)[: self._size - 4]
            # A button acts when it goes down.
            jaws, clutch = (on and not was for on, was in zip(reading.buttons, self._buttons))
            self._buttons = reading.buttons
            toggles ^= jaws
            if clutch:
                self._toggle_clutch()
        return by, toggles

    def _reading(self) -> Reading | None:
        """Reads the device; once it is lost, handle and keys remain."""
        try:
            return self._device.read() if self._device else None
        except DeviceLost as error:
            self._device = None
            page.notify(self._server, "The device was lost", str(error), is_error=True)
            return None

    def _settle(self) -> None:
        """Returns the handle to the target's tip."""
        arm = int(self._arm.value)
        self._handle.settle(self.targets[arm].goal, self._trocars[arm])

    def _toggle_clutch(self) -> None:
        self._clutch.value = not self._clutch.value
