"""A simulated SpaceMouse: its HID reports, through pyspacemouse, to a tool in the trocar.

Needs `pyspacemouse`, which no extra brings; the HID library under it is replaced. Run as a script,
or by pytest, which skips it where something is missing.
"""

import struct
import sys
import types

import numpy as np
import pytest

COMPACT = (0x256F, 0xC635)  # SpaceMouse Compact
FULL = 350  # counts of full deflection


class Unplugged(Exception):
    """Stands for easyhid's."""


class Fake:
    """A SpaceMouse Compact that sends given values."""

    vendor_id, product_id = COMPACT
    product_string, manufacturer_string = "SpaceMouse Compact", "3Dconnexion"
    release_number, serial_number, path = 1, "", "/dev/hidraw7"

    def __init__(self):
        self.reports, self.is_plugged = [], True

    def open(self):
        pass

    def close(self):
        pass

    def set_nonblocking(self, _):
        pass

    def read(self, size):
        if not self.is_plugged:
            raise Unplugged("read failed")
        return self.reports.pop(0) if self.reports else b""

    def push(self, right=0.0, toward=0.0, down=0.0, clockwise=0.0, buttons=0):
        """Reports as the device sends them: translation, rotation, buttons."""
        counts = [round(FULL * x) for x in (right, toward, down, 0, 0, clockwise)]
        self.reports += [
            bytes([1]) + struct.pack("<3h", *counts[:3]),
            bytes([2]) + struct.pack("<3h", *counts[3:]),
            bytes([3, buttons]),
        ]


def library(fake):
    """easyhid with this device alone."""
    found = types.SimpleNamespace(find=lambda *given, **named: [fake])
    return types.SimpleNamespace(
        Enumeration=lambda *given, **named: found, HIDException=Unplugged, HIDDevice=Fake
    )


def main():
    fake = Fake()
    sys.modules["easyhid"] = library(fake)  # before pyspacemouse is imported
    from starjax import rcm
    from starjax.addons.viewer import devices, teleop_target
    from starjax.sim import registries

    device = devices.open_device("spacemouse")
    np.testing.assert_array_equal(device.read().deflection, 0.0)
    for push, expected in (
        ({"right": 1.0}, [0, 1, 0, 0]),
        ({"toward": -0.5}, [0, 0, 0.5, 0]),
        ({"down": -1.0}, [0, 0, 0, 1]),
        ({"clockwise": -1.0}, [1, 0, 0, 0]),
        ({"right": 2.0}, [0, 1, 0, 0]),
    ):
        fake.push(**push)
        np.testing.assert_allclose(device.read().deflection, expected, atol=0.01)
    fake.push(buttons=2)
    assert device.read().buttons == (False, True)

    slot = registries.tasks.get("reach").slots[0]
    tip, axes = np.array([0.0, 0.0, 0.06]), teleop_target.view_axes(np.eye(3)[:, [1, 0, 2]])
    hand, bounds = (
        teleop_target.at_rest(np.array([0.0, *tip]), 1.0),
        teleop_target.bounds(slot, tip),
    )
    frame = rcm.trocar_frame(
        rcm.trocar_from_position([0.02, 0.01, 0.15], slot.p_world_ref), slot.p_world_ref
    )
    worst, random = 0.0, np.random.default_rng(0)
    for _ in range(300):
        fake.push(*random.uniform(-1, 1, 4))
        by = teleop_target.increment(device.read().deflection, axes, 1.0, 1 / 30)
        hand = teleop_target.smoothed(teleop_target.moved(hand, by, bounds), 1 / 30)
        pose, _ = rcm.ACTION_SPACES["rcm4"].decode(hand.action.astype(np.float32), frame)
        worst = max(worst, float(rcm.rcm_error(pose, frame.p_world_trocar)))
    moved = 1e3 * np.linalg.norm(hand.action[1:] - tip)
    assert worst < 1e-6 and moved > 1.0
    fake.is_plugged = False
    with pytest.raises(devices.DeviceLost):
        device.read()
    device.close()
    print(
        f"300 reports: the tip is {moved:.0f} mm from its start, "
        f"RCM error of the commands at most {1e3 * worst:.1e} mm"
    )


def test_a_spacemouse_steers(monkeypatch):
    monkeypatch.setitem(sys.modules, "easyhid", library(Fake()))
    pytest.importorskip("pyspacemouse")
    for name in [name for name in sys.modules if name.split(".")[0] == "pyspacemouse"]:
        monkeypatch.delitem(sys.modules, name)
    main()


if __name__ == "__main__":
    main()
