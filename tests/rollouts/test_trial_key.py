"""Keys of trials; bodies that an episode's draws put at rest lie where the environment has them."""

import jax
import mujoco
import numpy as np

from starjax.addons.viewer import stage
from starjax.rollouts import trial_key
from starjax.sim import registries, scene, still_bodies
from starjax.types import Pose


def test_the_marks_of_a_trial_are_where_its_needle_must_go():
    names = scene.name("needle_drive")
    task, model = registries.tasks.get("needle_drive"), scene.compose(names)
    key = trial_key.of_trial(5, 3, 2)
    bite = task.sample(task.bind(model), jax.random.split(key)[0]).bite
    still = trial_key.bodies_at_rest(names, 5, 3, 2)
    trocar = np.array([[0.0, 0.0, 0.15]])
    found = stage.kinematics(model)(model.qpos0, trocar, still)
    for name, p in (("entry", bite.entry), ("exit", bite.exit)):
        np.testing.assert_allclose(found.p[model.geom(name).id], p, atol=1e-7)
    np.testing.assert_allclose(found.p[model.geom("trocar0").id], trocar[0], atol=1e-7)
    assert trial_key.bodies_at_rest(names, None, 3, 2) is None
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
