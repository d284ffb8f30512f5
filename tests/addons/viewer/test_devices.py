"""Devices by their libraries, which are stood for here; `tests/peers` has a real one of them."""

import sys
import types

import numpy as np
import pytest

from starjax.addons.viewer import devices
from starjax.core import errors


def test_a_device_without_its_library_is_a_mistake(monkeypatch):
    for name, package in (("spacemouse", "pyspacemouse"), ("gamepad", "pygame")):
        monkeypatch.setitem(sys.modules, package, None)
        with pytest.raises(errors.UsageError) as raised:
            devices.open_device(name)
        assert package in raised.value.hint


def pygame(count=1):
    pad = types.SimpleNamespace(axes=[0.0] * 4, pressed=set())
    pad.get_axis, pad.get_button = lambda i: pad.axes[i], lambda i: i in pad.pressed
    stick = types.SimpleNamespace(
        init=lambda: None, get_count=lambda: count, Joystick=lambda i: pad
    )
    library = types.SimpleNamespace(
        display=types.SimpleNamespace(init=lambda: None),
        event=types.SimpleNamespace(pump=lambda: None),
        joystick=stick,
        quit=lambda: None,
    )
    return library, pad, stick


def test_a_gamepad(monkeypatch):
    library, pad, stick = pygame()
    monkeypatch.setitem(sys.modules, "pygame", library)
    device = devices.open_device("gamepad")
    pad.axes = [0.05, 0.02, -0.03, 0.0]  # as sticks rest
    np.testing.assert_array_equal(device.read().deflection, 0.0)
    pad.axes, pad.pressed = [1.0, -0.5, 0.25, -1.0], {1}  # right, away, roll, up
    reading = device.read()
    np.testing.assert_allclose(reading.deflection, [-0.25, 1.0, 0.5, 1.0])
    assert reading.buttons == (False, True)
    stick.get_count = lambda: 0
    with pytest.raises(devices.DeviceLost):
        device.read()


def test_a_spacemouse_bends_a_wrist_with_its_other_two_axes(monkeypatch):
    state = types.SimpleNamespace(
        t=1, x=0.1, y=0.2, z=0.3, roll=0.4, pitch=0.5, yaw=0.6, buttons=[1, 0]
    )
    mouse = types.SimpleNamespace(read=lambda: state, close=lambda: None)
    convention = types.SimpleNamespace(HID_Z_UP=0)
    library = types.SimpleNamespace(open=lambda **_: mouse, AxisConvention=convention)
    monkeypatch.setitem(sys.modules, "pyspacemouse", library)
    monkeypatch.setitem(sys.modules, "easyhid", types.SimpleNamespace(HIDException=OSError))
    reading = devices.open_device("spacemouse").read()
    np.testing.assert_allclose(reading.deflection, [0.6, 0.1, 0.2, 0.3])
    assert reading.bend == (0.5, 0.4) and reading.buttons == (True, False)


def test_no_gamepad_is_a_mistake(monkeypatch):
    monkeypatch.setitem(sys.modules, "pygame", pygame(count=0)[0])
    with pytest.raises(errors.UsageError):
        devices.open_device("gamepad")
