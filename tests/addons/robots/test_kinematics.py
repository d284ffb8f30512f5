"""Kinematics behind `servo_jp`: both ways, within limits, or refused."""

import mistakes
import numpy as np
import pytest

from starjax.addons.robots import kinematics, psm
from starjax.core.types import Pose
from starjax.sim import registries

ARMS = [("psm", "large_needle_driver"), ("psm", "prograsp")]
ARMS += [(arm, "grasper") for arm in ("fr5", "ur5e", "panda", "iiwa14")]


@pytest.fixture(scope="module", params=ARMS, ids="-".join)
def kin(request):
    return kinematics.of(*request.param, "peg_transfer")


def drawn(kin, spread):
    low, high = kin.limits.T
    q = kin.home + np.random.default_rng(0).uniform(-spread, spread, (10, len(kin.home)))
    return np.clip(q, low + 0.06, high - 0.06)


def test_joints_of_a_tip_reach_it_from_the_joints_before(kin):
    for q in drawn(kin, 0.01):
        tip = kin.tip_of(q)
        found = kin.joints_of(tip, kin.home)
        again = kin.tip_of(found)
        np.testing.assert_allclose(again.p, tip.p, atol=2e-5)
        np.testing.assert_allclose(again.R, tip.R, atol=2e-4)
        assert np.abs(found - kin.home).max() < 0.05  # the branch of the joints before


def test_a_tip_out_of_reach_is_refused(kin):
    tip = kin.tip_of(kin.home)
    with pytest.raises(kinematics.UsageError):
        kin.joints_of(Pose(tip.R, tip.p - 2.0 * tip.R[:, 2]), kin.home)


@pytest.mark.parametrize("joint", [0, 2])
def test_a_command_near_a_limit_may_only_leave_it(joint):
    kin = kinematics.of("psm", "large_needle_driver", "peg_transfer")
    high = kin.limits[joint, 1]
    margin = 0.005 if joint == 2 else 0.05

    def at(left):
        return kin.home + (high - left - kin.home[joint]) * np.eye(6)[joint]

    def move(before, after):
        return kin.joints_of(kin.tip_of(at(after)), at(before))

    np.testing.assert_allclose(move(2.0 * margin, 1.1 * margin), at(1.1 * margin), atol=1e-6)
    np.testing.assert_allclose(move(0.5 * margin, 0.8 * margin), at(0.8 * margin), atol=1e-6)
    for before, after in ((1.1, 0.9), (0.8, 0.5)):
        with mistakes.of(psm.JOINTS[joint]):
            move(before * margin, after * margin)


def test_the_shaft_has_the_axis_of_a_straight_wrist(kin):
    q = kin.home.copy()
    if kin.wrist is not None:
        q[4:] = 0.0
    shaft, tip = kin.shaft_of(q), kin.tip_of(q)
    np.testing.assert_allclose(shaft.R[:, 2], tip.R[:, 2], atol=1e-6)


def test_a_bent_tool_on_an_arm_of_the_registry_is_refused():
    with mistakes.of("arm.instrument", "needle_driver"):
        kinematics.of("fr5", "needle_driver", "peg_transfer")


def test_kinds_are_those_that_take_joints():
    kinds = set(kinematics.kinds())
    assert kinds & {"psm", *registries.arms.built_in} == {"psm", "fr5", "ur5e", "panda", "iiwa14"}
