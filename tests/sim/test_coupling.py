"""Forces of a task's own: the tips' motion that they get is MuJoCo's."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from starjax.sim import coupling, physics
from starjax.sim import scene as scenes
from starjax.sim.task import Coupling

GRIPPER = -jnp.ones(1)


@pytest.fixture(scope="module", params=["psm", "fr5"])
def scene(request):
    """A task without forces, whose memory counts steps."""
    made = scenes.load(scenes.name("reach", [request.param], ["needle_driver"]))
    toy = Coupling(
        begin=lambda bound, layout, qpos, tips: (qpos, 0),
        forces=lambda bound, layout, memory, motion: (jnp.zeros_like(motion.qvel), memory + 1),
    )
    return made._replace(task=made.task._replace(coupling=toy))


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


def test_memory_begins_at_reset_and_follows_each_step(scene):
    layout = scene.task.sample(scene.bound, jax.random.key(1))
    state = physics.initial(scene, [arm.home for arm in scene.arms], layout)
    assert state.memory == 0
    force, memory = coupling.forces(scene, layout, state, GRIPPER, jnp.asarray(scene.p_world_ref))
    assert memory == 1 and force.shape == state.qvel.shape
