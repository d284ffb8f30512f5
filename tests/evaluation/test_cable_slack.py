"""Slack cables: the wrist follows late, by at most the slack, on the shaft that was commanded."""

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from starjax import rcm
from starjax.cli import stress
from starjax.core import errors
from starjax.core.types import Command, Pose
from starjax.evaluation.disturbances import base, wrists

WRIST = rcm.LARGE_NEEDLE_DRIVER
ENV = SimpleNamespace(
    step=lambda state, command: command,
    scene=SimpleNamespace(arms=[SimpleNamespace(tool=SimpleNamespace(wrist=WRIST))]),
)
SHAFT = Pose(jnp.diag(jnp.array([1.0, -1.0, -1.0])), jnp.array([0.01, 0.0, 0.06]))


def executed(degrees, level):
    """Returns the commands, and those carried out, for commanded angles `[T, 2]`."""
    disturbance = base.DisturbanceState(jnp.asarray(level), None, jnp.zeros((1, 2)))
    wanted, done = [], []
    for angles in np.radians(degrees):
        tip = rcm.tip_of(WRIST, SHAFT, jnp.asarray(angles))
        command = Command(Pose(tip.R[None], tip.p[None]), jnp.ones(1), jnp.asarray(angles)[None])
        after, memory = wrists.CABLE_SLACK.on_step(ENV, disturbance, None, command)
        disturbance = disturbance._replace(memory=memory)
        wanted, done = [*wanted, command], [*done, after]
    return wanted, done


def test_wrist_is_off_by_the_slack_and_late_after_a_reversal():
    way = np.concatenate([np.arange(0.0, 21.0), np.arange(20.0, -1.0, -1.0)])
    degrees = np.stack([way, -way], -1)
    wanted, done = executed(degrees, 3.0)
    found = np.degrees([command.wrist[0] for command in done])
    off = found - degrees
    assert np.abs(off).max() < 3.0 + 1e-3
    np.testing.assert_allclose(off[10], [-3.0, 3.0], atol=1e-3)  # pulled one way
    np.testing.assert_allclose(off[-1], [3.0, -3.0], atol=1e-3)  # and the other
    assert np.ptp(found[20:27], axis=0).max() < 1e-3  # it rests while the slack is taken up
    for one, other in zip(wanted, done):
        assert np.abs(one.pose.p - other.pose.p).max() < 0.002
        shafts = [
            rcm.shaft_of(WRIST, Pose(c.pose.R[0], c.pose.p[0]), c.wrist[0]) for c in (one, other)
        ]
        np.testing.assert_allclose(shafts[0].p, shafts[1].p, atol=1e-6)
        np.testing.assert_allclose(shafts[0].R, shafts[1].R, atol=1e-5)


def test_no_slack_changes_nothing():
    wanted, done = executed(np.random.default_rng(0).uniform(-60.0, 60.0, (5, 2)), 0.0)
    for one, other in zip(wanted, done):
        np.testing.assert_array_equal(one.pose.p, other.pose.p)
        np.testing.assert_array_equal(one.pose.R, other.pose.R)
        np.testing.assert_array_equal(one.wrist, other.wrist)


def test_an_invalid_command_does_not_stay():
    _, done = executed([[10.0, 0.0], [np.nan, np.nan], [10.0, 0.0]], 1.0)
    np.testing.assert_allclose(np.degrees(done[-1].wrist[0]), [9.0, 0.0], atol=1e-3)


def test_straight_tools_never_meet_it():
    args = stress.StressArgs(disturbance=("cable_slack",))
    chosen = {"cable_slack": ()}
    with pytest.raises(errors.UsageError, match="wrist"):
        stress._kinds(args, chosen, "image", ("grasper",))
    assert "cable_slack" in stress._kinds(args, chosen, "image", ("needle_driver",))
    every = stress._kinds(stress.StressArgs(), {}, "image", ("grasper",))
    assert "cable_slack" not in every and "mass" in every
