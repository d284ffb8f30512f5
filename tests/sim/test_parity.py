"""MJX against C MuJoCo on the same composed model, and that a wrong model is noticed."""

import copy

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from starjax.sim import physics, solver
from starjax.tasks.peg_transfer import task

REST_SECONDS = 10.0
# How far a resting block may creep in that time (m): 0.23 mm in float32, 0 in float64.
REST_DRIFT = 3e-4
# One step of 1/240 s in float32 against float64: velocities (m/s, rad/s) agree to this. In contact
# C MuJoCo stops after 8 Newton iterations.
FREE_TOLERANCE = 2e-4
CONTACT_TOLERANCE = 2e-3


@pytest.fixture(scope="module")
def step(sim):
    """`(qpos, qvel, ctrl) -> (qvel, warm start)` of one MJX step."""

    @jax.jit
    def one(qpos, qvel, ctrl):
        data = sim.mjx_data.replace(qpos=qpos, qvel=qvel, ctrl=ctrl)
        data, _ = solver.step(sim.mjx_model, data)
        return data.qvel, data.qacc_warmstart

    return one


def c_step(m, qpos, qvel, ctrl):
    data = mujoco.MjData(m)
    data.qpos[:], data.qvel[:], data.ctrl[:] = qpos, qvel, ctrl
    mujoco.mj_step(m, data)
    pairs = {
        tuple(sorted((m.geom(c.geom1).name, m.geom(c.geom2).name)))
        for c in data.contact
        if c.dist < 0
    }
    return np.array(data.qvel), np.array(data.qacc_warmstart), pairs


def settled(sim):
    """Coordinates of the block on its peg, arm at home, jaws open; control that holds them."""
    m = sim.mj_model
    [arm] = sim.arms
    layout = task.sample(sim.bound, jax.random.key(0))
    place = jnp.array([*sim.bound.pegs[4], task.RIM_HEIGHT])
    layout = layout.replace(block=layout.block._replace(R=jnp.eye(3), p=place))
    state = physics.initial(sim, [jnp.asarray(arm.home)], layout)
    ctrl = np.zeros(m.nu)
    ctrl[arm.ctrl], ctrl[arm.jaw_ctrl] = arm.home, arm.tool.open
    return np.array(state.qpos), ctrl, m


def situations(sim):
    """Name, coordinates, control and the pair that must touch: one of each kind of contact."""
    qpos, ctrl, _ = settled(sim)
    rim, tube = task.RIM_RADIUS, task.WALL_RADIUS
    peg = sim.bound.pegs[4]

    def placed(p, quat=(1, 0, 0, 0)):
        at = qpos.copy()
        at[sim.bound.block : sim.bound.block + 3] = p
        at[sim.bound.block + 3 : sim.bound.block + 7] = quat
        return at

    yield "free flight", placed([0.0, 0.0, 0.2]), ctrl, None
    yield "foot on board", placed([*peg, task.RIM_HEIGHT - 2e-4]), ctrl, ("foot0", "table")
    aside = [peg[0] + rim - tube - 0.001125 + 2e-4, peg[1], 0.0085 + 0.001]
    yield "wall on peg", placed(aside, (0, 0, 0, 1)), ctrl, ("peg4", "wall0")
    data = mujoco.MjData(sim.mj_model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(sim.mj_model, data)
    tcp = data.site("arm0/tool/tcp")
    # The wall between the pads: wall 0 along the gap, the block tilted as the tool is.
    R = np.array(tcp.xmat).reshape(3, 3)
    out, up = R[:, 1], -R[:, 2]
    block = np.stack([out, np.cross(up, out), up], axis=1)
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, block.flatten())
    grasped = placed(np.array(tcp.xpos) - rim * out, quat)
    grasped[sim.arms[0].jaws] = tube - 5e-5
    yield "pads on wall", grasped, ctrl, ("arm0/tool/pad_left", "wall0")


def test_kinematics_agree(sim):
    rng = np.random.default_rng(0)
    qpos, _, m = settled(sim)
    p_trocar = np.array([[0.01, -0.02, 0.16]])
    poses = jax.jit(lambda q: physics.kinematics(sim, q, jnp.asarray(p_trocar)))
    start = sim.bound.block + 3
    for _ in range(5):
        q = qpos + rng.normal(0, 0.2, m.nq)
        q[start : start + 4] /= np.linalg.norm(q[start : start + 4])
        data = mujoco.MjData(m)
        data.qpos[:], data.mocap_pos[:] = q, p_trocar
        mujoco.mj_kinematics(m, data)
        placed = poses(jnp.asarray(q, jnp.float32))
        np.testing.assert_allclose(placed.geom_xpos, data.geom_xpos, atol=2e-6)
        np.testing.assert_allclose(placed.geom_xmat, data.geom_xmat.reshape(-1, 3, 3), atol=2e-6)


def test_one_step_of_every_contact_pair_agrees(sim, step):
    for name, qpos, ctrl, pair in situations(sim):
        *theirs, touching = c_step(sim.mj_model, qpos, np.zeros(sim.mj_model.nv), ctrl)
        assert pair is None or tuple(sorted(pair)) in touching, (name, touching)
        ours = step(jnp.asarray(qpos), jnp.zeros(sim.mj_model.nv), jnp.asarray(ctrl))
        tolerance = FREE_TOLERANCE if pair is None else CONTACT_TOLERANCE
        np.testing.assert_allclose(ours[0], theirs[0], atol=tolerance, err_msg=name)
        of_acceleration = tolerance / sim.mj_model.opt.timestep
        np.testing.assert_allclose(ours[1], theirs[1], atol=of_acceleration, err_msg=name)


def test_a_wrong_gravity_would_be_noticed(sim, step):
    """The comparison above must fail on a planted error."""
    wrong = copy.deepcopy(sim.mj_model)
    wrong.opt.gravity[2] = -9.0
    _, qpos, ctrl, _ = next(situations(sim))
    qvel, _, _ = c_step(wrong, qpos, np.zeros(wrong.nv), ctrl)
    ours, _ = step(jnp.asarray(qpos), jnp.zeros(wrong.nv), jnp.asarray(ctrl))
    assert np.abs(np.asarray(ours) - qvel).max() > 5 * FREE_TOLERANCE


@pytest.mark.slow
def test_a_block_rests_on_its_peg_for_ten_seconds(sim):
    qpos, ctrl, m = settled(sim)
    steps = round(REST_SECONDS / m.opt.timestep)

    @jax.jit
    def rest(qpos):
        def one(_, carry):
            data = sim.mjx_data.replace(
                qpos=carry[0], qvel=carry[1], qacc_warmstart=carry[2], ctrl=jnp.asarray(ctrl)
            )
            data, _ = solver.step(sim.mjx_model, data)
            return data.qpos, data.qvel, data.qacc_warmstart

        still = jnp.zeros(m.nv)
        return jax.lax.fori_loop(0, steps, one, (qpos, still, still))

    ours = np.asarray(rest(jnp.asarray(qpos))[0])
    data = mujoco.MjData(m)
    data.qpos[:], data.ctrl[:] = qpos, ctrl
    for _ in range(steps):
        mujoco.mj_step(m, data)
    block = slice(sim.bound.block, sim.bound.block + 7)
    np.testing.assert_allclose(ours[block], data.qpos[block], atol=REST_DRIFT)
    np.testing.assert_allclose(data.qpos[block], qpos[block], atol=REST_DRIFT)


def test_constants_in_code_are_those_of_the_model(sim):
    m = sim.mj_model
    [bound] = sim.arms
    wall = m.geom("wall0")
    assert np.isclose(np.linalg.norm(wall.pos[:2]), task.RIM_RADIUS, atol=1e-6)
    assert np.isclose(wall.size[0], task.WALL_RADIUS)
    assert np.isclose(m.body("block").pos[2], task.RIM_HEIGHT)
    assert np.isclose(m.geom("peg0").size[0], task.PEG_RADIUS)
    top = m.geom("peg0").pos[2] + m.geom("peg0").size[1] + m.geom("peg0").size[0]
    assert np.isclose(top, task.PEG_HEIGHT)
    assert np.isclose(m.geom("arm0/tool/shaft").size[0], bound.tool.shaft_radius)
    w = bound.arm.servo_frequency
    inertia = m.actuator_gainprm[bound.ctrl, 0] / w**2
    damping = -m.actuator_biasprm[bound.ctrl, 2]
    np.testing.assert_allclose(damping, 2 * w * inertia, rtol=1e-6)
