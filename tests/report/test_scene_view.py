"""Shafts of recorded joints, for line drawings."""

import numpy as np

from starjax import rcm
from starjax.report import scene_view
from starjax.sim import scene


def test_a_bent_wrist_ends_the_shaft_before_the_tip():
    names = scene.name("reach", ["psm"], ["needle_driver"])
    model, trocar = scene.compose(names), np.array([[0.01, 0.02, 0.15]])
    qpos = np.repeat(model.qpos0[None], 2, 0)
    qpos[1, model.joint("arm0/tool/pitch").qposadr[0]] = 0.6
    qpos[1, model.joint("arm0/tool/yaw").qposadr[0]] = -0.4
    qpos[:, model.joint("arm0/outer_insertion").qposadr[0]] += 0.05
    tip, end, axis = (x[:, 0] for x in scene_view.load(names).shafts(qpos, trocar))
    np.testing.assert_allclose(np.cross(end - trocar[0], axis), 0.0, atol=1e-6)
    wrist = rcm.LARGE_NEEDLE_DRIVER
    straight = np.linalg.norm(tip[0] - end[0])
    np.testing.assert_allclose(straight, wrist.clevis + wrist.jaws, atol=1e-6)
    bent = rcm.tip_of(wrist, rcm.Pose(np.eye(3), np.zeros(3)), [0.6, -0.4]).p
    np.testing.assert_allclose(np.linalg.norm(tip[1] - end[1]), np.linalg.norm(bent), atol=1e-6)
