"""Targets: kept within bounds, smooth, on the RCM manifold."""

import numpy as np
import pytest

from starjax import rcm
from starjax.addons.viewer import teleop_target
from starjax.sim import registries

SLOT = registries.tasks.get("reach").slots[0]
TIP = np.array([0.0, 0.01, 0.07])
BOUNDS = teleop_target.bounds(SLOT, TIP)


def at_rest():
    return teleop_target.at_rest(np.array([0.1, *TIP]), 1.0)


@pytest.mark.parametrize("seed", range(3))
def test_any_motion_stays_within_bounds_and_on_the_manifold(seed):
    random = np.random.default_rng(seed)
    target = at_rest()
    trocar = rcm.trocar_frame(
        rcm.trocar_from_position([0.02, 0.01, 0.15], SLOT.p_world_ref), SLOT.p_world_ref
    )
    actions = []
    for _ in range(200):
        target = teleop_target.smoothed(
            teleop_target.moved(target, 0.02 * random.normal(size=4), BOUNDS), 1 / 30
        )
        actions.append(target.action)
    actions = np.stack(actions)
    assert (actions >= BOUNDS.low - 1e-9).all() and (actions <= BOUNDS.high + 1e-9).all()
    assert np.ptp(actions, axis=0).min() > 0.01  # it did move
    pose, _ = rcm.ACTION_SPACES["rcm4"].decode(actions.astype(np.float32), trocar)
    assert np.max(rcm.rcm_error(pose, trocar.p_world_trocar)) < 1e-6


def test_bounds_hold_the_start_and_end_above_the_table():
    assert (BOUNDS.low[1:] < TIP).all() and (BOUNDS.high[1:] > TIP).all()
    assert BOUNDS.low[3] >= registries.tasks.get("reach").floor


def test_a_step_of_a_key_arrives_smoothly_and_whole():
    target = teleop_target.moved(at_rest(), np.array([0, 0.0015, 0, 0]), BOUNDS)
    path = []
    for _ in range(60):
        target = teleop_target.smoothed(target, 1 / 30)
        path.append(target.action[1])
    steps = np.diff([TIP[0], *path])
    assert (steps > 0).all() and steps.max() < 0.5 * 0.0015  # never at once
    assert path[-1] == pytest.approx(0.0015, rel=1e-6)


def test_scale_and_axes_of_a_device():
    # a camera that looks along -x: its right is +y, away is -x
    axes = teleop_target.view_axes(
        np.array([[0.0, -0.59, 0.81], [1.0, 0.0, 0.0], [0.0, 0.81, 0.59]])
    )
    for deflection, way in (([0, 1, 0, 0], [0, 1, 0]), ([0, 0, 1, 0], [-1, 0, 0])):
        by = teleop_target.increment(np.array(deflection, float), axes, 0.5, 0.1)
        np.testing.assert_allclose(
            by, [0, *(0.5 * 0.1 * teleop_target.SPEED * np.array(way))], atol=1e-12
        )
    assert (
        teleop_target.increment(np.array([1.0, 0, 0, 0]), axes, 2.0, 0.1)[0]
        == 0.2 * teleop_target.SPIN
    )
