"""Bodies that an episode's draws put at rest lie where the environment has them."""

import mujoco
import numpy as np

from starjax.core.types import Pose
from starjax.sim import scene, still_bodies
from starjax.sim.rollouts import trial_key


def test_a_task_without_marks_has_no_bodies_at_rest():
    assert trial_key.bodies_at_rest(scene.name("reach"), 5, 3, 2) is None


def test_a_turned_body_is_placed_with_its_rotation():
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body name='still0' mocap='true'/></worldbody></mujoco>"
    )
    data, R = mujoco.MjData(model), np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    still_bodies.place(model, data, Pose(R[None], np.array([[1.0, 2.0, 3.0]])))
    mujoco.mj_kinematics(model, data)
    np.testing.assert_allclose(data.body("still0").xmat.reshape(3, 3), R, atol=1e-12)
    np.testing.assert_allclose(data.body("still0").xpos, [1, 2, 3])
