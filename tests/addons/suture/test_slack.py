"""Leads: a tip that stays behind its commands comes to the script's pose, any other is not led."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stubs
from jax.scipy.spatial.transform import Rotation

from starjax.addons.suture import slack
from starjax.core.types import Command, Pose
from starjax.sim import ik

TIP = Pose(jnp.diag(jnp.array([1.0, -1.0, -1.0])), jnp.array([0.01, 0.0, 0.02]))


def behind(slack_deg, steps):
    """Returns the lead, its last command, and the tip, `slack_deg` behind every command."""
    turn = jnp.deg2rad(jnp.array([-slack_deg, 0.0, 0.0]))

    @jax.jit
    def step(lead, tip):
        lead = slack.update(lead, stubs.one_tool(tip, None, None))
        asked = slack.led(lead, TIP)
        command = Command(Pose(asked.R[None], asked.p[None]), jnp.ones(1))
        R = jnp.where(turn.any(), Rotation.from_rotvec(turn).as_matrix() @ asked.R, asked.R)
        return slack.sent(lead, command), asked, Pose(R, asked.p + 0.01 * turn)

    lead, asked, tip = slack.none(stubs.one_tool(TIP, None, None)), TIP, TIP
    for _ in range(steps):
        lead, asked, tip = step(lead, tip)
    return lead, asked, tip


def off_deg(tip):
    return np.rad2deg(np.linalg.norm(ik.rotation_between(tip.R, TIP.R)))


@pytest.mark.parametrize("slack_deg", [1.0, -5.0])
def test_a_tip_that_stays_behind_is_led_to_the_scripts_pose(slack_deg):
    assert off_deg(behind(slack_deg, 1)[2]) > 0.9
    lead, _, tip = behind(slack_deg, 30)
    assert off_deg(tip) < 0.02 and np.linalg.norm(tip.p - TIP.p) < 1e-5
    assert np.rad2deg(np.linalg.norm(lead.ahead[:3])) < abs(slack_deg) + 0.01


@pytest.mark.parametrize("slack_deg", [0.0, 0.5])
def test_a_tip_that_follows_is_not_led_at_all(slack_deg):
    lead, asked, _ = behind(slack_deg, 10)
    np.testing.assert_array_equal(lead.ahead, 0.0)
    np.testing.assert_array_equal(asked.R, TIP.R)
    np.testing.assert_array_equal(asked.p, TIP.p)
