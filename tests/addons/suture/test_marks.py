"""Marks of a trial lie where its needle must go."""

import jax
import mujoco
import numpy as np

from starjax.sim import registries, scene, still_bodies
from starjax.sim.rollouts import trial_key


def test_the_marks_of_a_trial_are_where_its_needle_must_go():
    names = scene.name("needle_drive")
    task, model = registries.tasks.get("needle_drive"), scene.compose(names)
    key = trial_key.of_trial(5, 3, 2)
    bite = task.sample(task.bind(model), jax.random.split(key)[0]).bite
    data = mujoco.MjData(model)
    still_bodies.place(model, data, trial_key.bodies_at_rest(names, 5, 3, 2))
    mujoco.mj_kinematics(model, data)
    for name, p in (("entry", bite.entry), ("exit", bite.exit)):
        np.testing.assert_allclose(data.geom(name).xpos, p, atol=1e-6)
    assert trial_key.bodies_at_rest(names, None, 3, 2) is None
