"""The needle in the jaws at reset."""

import jax
import mujoco
import numpy as np
import pytest

from starjax.sim import physics
from starjax.sim import scene as scenes


@pytest.fixture(scope="module", params=["psm", "fr5"])
def scene(request):
    return scenes.load(scenes.name("needle_drive", [request.param]))


def test_the_needle_begins_between_the_jaws(scene):
    layout = scene.task.sample(scene.bound, jax.random.key(1))
    state = physics.initial(scene, [arm.home for arm in scene.arms], layout)
    (arm,), data = scene.arms, mujoco.MjData(scene.mj_model)
    data.qpos[:] = state.qpos
    mujoco.mj_kinematics(scene.mj_model, data)
    tip = data.site(scenes.tcp(0, arm.tool)).xpos
    wires = np.array([data.geom(f"wire{k}").xpos for k in range(7)])
    # The wire passes the tip: a third from the swage, within a segment.
    assert np.linalg.norm(wires - tip, axis=1).argmin() == 2
    assert (np.asarray(physics.openings(scene, state.qpos)) <= -1.0).all()
    assert state.memory.patches.is_held.all()
