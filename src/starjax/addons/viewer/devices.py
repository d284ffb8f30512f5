"""Input devices: a SpaceMouse or a gamepad, through their optional libraries."""

import importlib
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from starjax.core import errors

_DEAD_ZONE = 0.08  # part of a stick's range, about its centre


class Reading(NamedTuple):
    """One reading of a device.

    Attributes:
      deflection: `[4]` in [-1, 1]: roll, right, away, up.
      buttons: pressed states of the first (jaws) and the second (clutch).
      bend: `[2]` in [-1, 1]: pitch and yaw of a wrist; 0 of a device with fewer axes.
    """

    deflection: np.ndarray
    buttons: tuple[bool, bool]
    bend: tuple[float, float] = (0.0, 0.0)


class DeviceLost(OSError):
    """A device that can no longer be read."""


class Device(NamedTuple):
    """An open device.

    Attributes:
      read: () -> Reading, without waiting; raises `DeviceLost`.
      close: releases the device.
    """

    read: Callable[[], Reading]
    close: Callable[[], None]


def _spacemouse() -> Device:
    library = _library("pyspacemouse", "spacemouse")
    try:
        mouse = library.open(axis_convention=library.AxisConvention.HID_Z_UP)
    except (RuntimeError, OSError, ValueError) as error:
        hint = "on Linux, the user needs read permission: a udev rule for vendor 256f"
        raise errors.UsageError("--device", "a SpaceMouse", error, hint) from error

    unplugged = _library("easyhid", "spacemouse").HIDException

    def read() -> Reading:
        before = None
        try:
            state = mouse.read()
            while state.t != before:  # skips to the latest report
                before, state = state.t, mouse.read()
        except unplugged as error:
            raise DeviceLost(str(error)) from error
        pressed = [*map(bool, state.buttons), False, False]
        deflection = np.array([state.yaw, state.x, state.y, state.z])
        pitch, yaw = np.clip([state.pitch, state.roll], -1.0, 1.0).tolist()
        return Reading(np.clip(deflection, -1.0, 1.0), (pressed[0], pressed[1]), (pitch, yaw))

    return Device(read, mouse.close)


def _gamepad() -> Device:
    library = _library("pygame", "gamepad")
    library.display.init()
    library.joystick.init()
    if not library.joystick.get_count():
        library.quit()
        raise errors.UsageError("--device", "a connected gamepad", "no gamepad")
    pad = library.joystick.Joystick(0)

    def read() -> Reading:
        library.event.pump()
        if not library.joystick.get_count():
            raise DeviceLost("unplugged")
        # left stick: right and away; right stick: roll and up
        sticks = np.array([pad.get_axis(i) for i in range(4)])
        sticks = np.where(np.abs(sticks) < _DEAD_ZONE, 0.0, sticks)
        right, toward, roll, down = sticks
        deflection = np.array([-roll, right, -toward, -down])
        buttons = bool(pad.get_button(0)), bool(pad.get_button(1))
        return Reading(np.clip(deflection, -1.0, 1.0), buttons)

    return Device(read, library.quit)


DEVICES: dict[str, Callable[[], Device]] = {"spacemouse": _spacemouse, "gamepad": _gamepad}


def open_device(name: str) -> Device:
    """Opens a device.

    Raises:
      errors.UsageError: no such device is connected, or its library is not installed.
    """
    errors.choice("--device", name, DEVICES)
    return DEVICES[name]()


def _library(package: str, device: str) -> Any:
    try:
        return importlib.import_module(package)
    except ImportError as error:
        hint = f"pip install {package}"
        raise errors.UsageError(f"--device {device}", package, "no such package", hint) from error
    except (OSError, AttributeError) as error:  # its C library is missing
        raise errors.UsageError(f"--device {device}", f"a working {package}", error) from error
