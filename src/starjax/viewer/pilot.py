"""A person's hands on the page, the handle at the tip, keys, a device: into one Hand an arm."""

import queue
import time
from typing import Any

import numpy as np

from starjax.viewer import hand as hands
from starjax.viewer.devices import Device, Gone, Reading
from starjax.viewer.status import notify

KEY_STEP = 0.0015  # m a stroke, with a scale of 1; holding a key repeats it
KEY_TURN = 0.05  # rad
_HANDLE = 0.045  # m, length of the handle's arrows
_LET_GO_S = 0.4  # without a move, until the handle returns to the tip
# key -> (what it does, increment: roll, right, away, up)
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
_HELP = (
    "Drag the arrows at the tip, or press arrows, Page Up and Page Down, Q and E (roll), "
    "G (jaws), C (clutch)."
)


class Pilot:
    """Reads all of it, and holds what each arm is asked.

    Attributes:
      hands: one for each arm.
      has_moved: whether any was moved since `rest`.
    """

    def __init__(self, server: Any, arms: int, axes: np.ndarray, device: Device | None):
        self._server, self._axes, self._device = server, axes, device
        self._buttons = (False, False)
        self._strokes: queue.SimpleQueue[tuple[np.ndarray, bool]] = queue.SimpleQueue()
        gui = server.gui
        gui.add_markdown(_HELP)
        names = tuple(str(i) for i in range(arms))
        self._arm = gui.add_dropdown("Arm", names, visible=arms > 1)
        self._clutch = gui.add_checkbox("Clutch", True, hint="C: off, the hand moves freely")
        self._scale = gui.add_slider("Scale", 0.1, 2.0, 0.1, 1.0, hint="tool over hand")
        self._handle = server.scene.add_transform_controls(
            "/hand", scale=_HANDLE, disable_rotations=True, depth_test=False
        )
        self._seen = np.zeros(3)
        for key, (what, by) in _MOVES.items():
            command = gui.add_command(what.capitalize(), hotkey=key)
            command.on_trigger(lambda _, by=by: self._strokes.put((np.array(by), False)))
        jaws = gui.add_command("Open or close the jaws", hotkey="G")
        jaws.on_trigger(lambda _: self._strokes.put((np.zeros(4), True)))
        clutch = gui.add_command("Clutch", hotkey="C")
        clutch.on_trigger(lambda _: self._toggle_clutch())

    def rest(self, actions: np.ndarray, openings: np.ndarray, bounds: list[hands.Bounds]) -> None:
        """Asks for what is there: actions `[A, 4]` of `rcm4`, openings `[A]`."""
        self.hands = [hands.resting(a, float(o)) for a, o in zip(actions, openings, strict=True)]
        self._bounds, self.has_moved = bounds, False
        while not self._strokes.empty():
            self._strokes.get()
        self._settle()

    def read(self, period: float) -> tuple[np.ndarray, np.ndarray]:
        """Advances by one period (s); returns actions `[A, 4]` and openings `[A]`."""
        arm = int(self._arm.value)
        by, squeezes = self._asked(period)
        if self._clutch.value and by.any():
            self.hands[arm] = hands.moved(self.hands[arm], by, self._bounds[arm])
            self.has_moved = True
        if squeezes:
            self.hands[arm] = hands.turned(self.hands[arm])
            self.has_moved = True
        self.hands = [hands.smoothed(one, period) for one in self.hands]
        if time.time() - self._handle.update_timestamp > _LET_GO_S:
            self._settle()
        return (
            np.stack([one.action for one in self.hands]),
            np.array([one.gripper for one in self.hands]),
        )

    def _asked(self, period: float) -> tuple[np.ndarray, bool]:
        """The increment `[4]` (rad, m in the world frame), and whether the jaws turn."""
        by, squeezes, scale = np.zeros(4), False, float(self._scale.value)
        now = np.array(self._handle.position)
        by[1:], self._seen = scale * (now - self._seen), now
        steps = scale * np.array([KEY_TURN, KEY_STEP, KEY_STEP, KEY_STEP])
        while not self._strokes.empty():
            stroke, turns = self._strokes.get()
            by += steps * np.array([stroke[0], *(self._axes @ stroke[1:])])
            squeezes ^= turns
        if reading := self._reading():
            before = self._buttons
            by += hands.increment(reading.deflection, self._axes, scale, period)
            self._buttons = reading.buttons
            pressed = [now and not once for now, once in zip(reading.buttons, before)]
            squeezes ^= pressed[0]
            if pressed[1]:
                self._toggle_clutch()
        return by, squeezes

    def _reading(self) -> Reading | None:
        """A look at the device; after it has gone, none: the page's own hands go on."""
        try:
            return self._device.read() if self._device else None
        except Gone as error:
            self._device = None
            notify(self._server, "The device has gone", str(error), is_bad=True)
            return None

    def _settle(self) -> None:
        """The handle returns to the tip that is asked for."""
        tip = self.hands[int(self._arm.value)].wanted[1:]
        if not np.array_equal(self._seen, tip):
            self._handle.position = tip
            self._seen = np.array(self._handle.position)

    def _toggle_clutch(self) -> None:
        self._clutch.value = not self._clutch.value
