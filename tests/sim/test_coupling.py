"""Forces of a task's own: the tips' motion that they get is MuJoCo's."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from starjax.sim import coupling, physics
from starjax.sim import scene as scenes

GRIPPER = -jnp.ones(1)


@pytest.fixture(scope="module", params=["psm", "fr5"])
def scene(request):
    return scenes.load(scenes.name("needle_drive", [request.param]))


def test_tips_and_their_jacobians_are_those_of_mujoco(scene):
    found = []
    spy = scene.task.coupling._replace(
        forces=lambda bound, layout, memory, motion: (found.append(motion), memory)
    )
    scene = scene._replace(task=scene.task._replace(coupling=spy))
    (arm,), m = scene.arms, scene.mj_model
    rng = np.random.default_rng(0)
    data, p_trocar = mujoco.MjData(m), scene.p_world_ref
    for _ in range(5):
        qpos = np.array(m.qpos0)
        qpos[arm.q] = arm.home + rng.uniform(-0.3, 0.3, len(arm.q))
        qvel = np.float32(rng.normal(size=m.nv))
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_forward(m, data)
        state = physics.PhysicsState(jnp.asarray(qpos, jnp.float32), qvel, qvel)
        with jax.default_matmul_precision("highest"):
            coupling.forces(scene, None, state, GRIPPER, jnp.asarray(p_trocar))
        motion, site = found.pop(), m.site(scenes.tcp(0, arm.tool)).id
        np.testing.assert_allclose(motion.pose.p[0], data.site_xpos[site], atol=2e-6)
        np.testing.assert_allclose(motion.pose.R[0].ravel(), data.site_xmat[site], atol=2e-6)
        moves, turns = np.zeros((3, m.nv)), np.zeros((3, m.nv))
        mujoco.mj_jacSite(m, data, moves, turns, site)
        np.testing.assert_allclose(motion.jacobian[0], np.concatenate([moves, turns]), atol=3e-6)


def test_a_task_without_forces_of_its_own_has_neither_forces_nor_memory(scene):
    bare = scene._replace(task=scene.task._replace(coupling=None))
    assert coupling.forces(bare, None, None, GRIPPER, jnp.asarray(scene.p_world_ref)) == (
        None,
        None,
    )


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
