"""Wrists, trocars and names that nothing can be made of are refused in one line."""

import numpy as np
import pytest

from starjax import rcm

WRIST = rcm.LARGE_NEEDLE_DRIVER
POSE = rcm.Pose(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
TROCAR = np.array([0.0, 0.0, 0.15])
MAPS = (
    lambda wrist: rcm.through(wrist, POSE, TROCAR),
    lambda wrist: rcm.angles_through(wrist, POSE, TROCAR),
    lambda wrist: rcm.tip_of(wrist, POSE, np.zeros(2)),
    lambda wrist: rcm.shaft_of(wrist, POSE, np.zeros(2)),
    rcm.rcm6,
    rcm.se3_through,
    rcm.se3_wrist,
)


@pytest.mark.parametrize("use", MAPS)
@pytest.mark.parametrize(
    ("wrist", "name"),
    [
        (WRIST._replace(pitch=80.0), "wrist.pitch"),  # degrees
        (WRIST._replace(yaw=-0.1), "wrist.yaw"),
        (WRIST._replace(clevis=9.1), "wrist.clevis"),  # mm
        (WRIST._replace(jaws=np.nan), "wrist.jaws"),
        ("large_needle_driver", "wrist"),
        (None, "wrist"),
    ],
)
def test_what_is_no_wrist_is_named(use, wrist, name):
    with pytest.raises(ValueError, match=rf"^{name}: expected [^\n]*$"):
        use(wrist)


def test_a_trocar_is_no_position():
    for use in (rcm.rcm_error, rcm.project, lambda *x: rcm.through(WRIST, *x)):
        with pytest.raises(ValueError, match=r"^p_world_trocar: expected an array, got Trocar$"):
            use(POSE, rcm.Trocar(0.03, 1.5, 0.2))


def test_an_unknown_action_space_is_named():
    with pytest.raises(ValueError, match=r"^action_space: expected one of [^\n]*rcm6[^\n]*$"):
        rcm.action_space("rcm7", WRIST)
