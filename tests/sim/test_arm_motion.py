"""Kinematics of the arm, and the controller between two commands."""

import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.core.types import Pose
from starjax.sim import control, ik

PERIOD = 1 / 30


def on_manifold(trocar, p, roll):
    action = jnp.concatenate([jnp.atleast_1d(roll), p])
    pose, _ = rcm.ACTION_SPACES["rcm4"].decode(action, trocar, jnp.array([0.0, 0.0, 0.15]))
    return pose


def first_trocar():
    return rcm.Trocar(*(jnp.asarray(field[0]) for field in rcm.TROCARS))


def test_inverse_kinematics_reach_every_trocar_and_peg(sim):
    trocars = rcm.Trocar(*(jnp.asarray(field) for field in rcm.TROCARS))
    tips = jnp.array([[x, y, 0.008] for x, y in sim.bound.pegs])

    def reach(trocar, p, roll):
        q, residual = ik.solve(
            sim.arms[0].chain, on_manifold(trocar, p, roll), jnp.asarray(sim.arms[0].home), 40
        )
        low, high = sim.arms[0].chain.limits[:, 0], sim.arms[0].chain.limits[:, 1]
        return residual, jnp.min(jnp.minimum(q - low, high - q))

    grid = jax.vmap(jax.vmap(jax.vmap(reach, (None, None, 0)), (None, 0, None)), (0, None, None))
    residual, margin = jax.jit(grid)(trocars, tips, jnp.array([-1.2, 0.0, 1.2]))
    assert residual.max() < 1e-5
    assert margin.min() > 0.1  # rad


def test_a_near_command_is_reached_at_once():
    trocar = first_trocar()
    here = on_manifold(trocar, jnp.array([0.01, 0.0, 0.03]), 0.1)
    there = on_manifold(trocar, jnp.array([0.0105, 0.0003, 0.0298]), 0.12)
    port = rcm.trocar_position(trocar, jnp.array([0.0, 0.0, 0.15]))
    pose, _ = control.toward(here, jnp.zeros(7), there, port, PERIOD)
    np.testing.assert_array_equal(pose.R, there.R)
    np.testing.assert_array_equal(pose.p, there.p)


def test_a_far_command_is_approached_along_the_manifold():
    trocar = first_trocar()
    port = rcm.trocar_position(trocar, jnp.array([0.0, 0.0, 0.15]))
    pose = on_manifold(trocar, jnp.array([-0.04, 0.02, 0.05]), -1.0)
    goal = on_manifold(trocar, jnp.array([0.04, -0.03, 0.01]), 1.0)
    velocity, toward = jnp.zeros(7), jax.jit(control.toward, static_argnums=4)
    for _ in range(60):
        before, last = pose, velocity
        pose, velocity = toward(pose, velocity, goal, port, PERIOD)
        assert float(rcm.rcm_error(pose, port)) < 1e-6
        change = jnp.linalg.norm(velocity[:3] - last[:3]) / PERIOD
        assert float(change) <= control.MAX_ACCELERATION * 1.001
        assert float(jnp.linalg.norm(pose.p - before.p)) <= control.MAX_SPEED * PERIOD * 1.001
    np.testing.assert_allclose(pose.p, goal.p, atol=1e-4)
    np.testing.assert_allclose(pose.R, goal.R, atol=2e-2)


def test_a_tool_at_the_least_depth_moves_along_the_manifold():
    """`rcm` maps all tips nearer to the port to such ones."""
    trocar = first_trocar()
    port = rcm.trocar_position(trocar, jnp.array([0.0, 0.0, 0.15]))
    axes = jax.random.normal(jax.random.key(0), (2, 64, 3)) * jnp.array([0.4, 0.4, 0.0])
    rolls = jax.random.uniform(jax.random.key(1), (2, 64), minval=-1.5, maxval=1.5)
    pose, goal = (
        rcm.pose_on_manifold(axis - jnp.array([0.0, 0.0, 1.0]), roll, depth, port)
        for axis, roll, depth in zip(axes, rolls, (0.03, rcm.MIN_DEPTH))
    )
    velocity = jnp.zeros((64, 7))
    toward = jax.jit(jax.vmap(lambda *at: control.toward(*at, port, PERIOD)))
    for _ in range(90):
        pose, velocity = toward(pose, velocity, goal)
        assert float(rcm.rcm_error(pose, port).max()) < 1e-6
    np.testing.assert_allclose(pose.R, goal.R, atol=1e-3)


def test_a_command_off_the_manifold_stays_off_it():
    """The controller does not project: a naive method's violation stays."""
    trocar = first_trocar()
    port = rcm.trocar_position(trocar, jnp.array([0.0, 0.0, 0.15]))
    good = on_manifold(trocar, jnp.array([0.0, 0.0, 0.03]), 0.0)
    bad = Pose(good.R, good.p + 0.02 * good.R[:, 0])
    pose, velocity = bad, jnp.zeros(7)
    for _ in range(5):
        pose, velocity = control.toward(pose, velocity, bad, port, PERIOD)
    np.testing.assert_allclose(rcm.rcm_error(pose, port), 0.02, atol=1e-5)


def test_a_far_command_off_the_manifold_is_missed_by_a_share_on_the_way():
    trocar = first_trocar()
    port = rcm.trocar_position(trocar, jnp.array([0.0, 0.0, 0.15]))
    pose = on_manifold(trocar, jnp.array([-0.04, 0.0, 0.03]), 0.0)
    good = on_manifold(trocar, jnp.array([0.04, 0.0, 0.03]), 0.0)
    bad = Pose(good.R, good.p + 0.02 * good.R[:, 1])
    velocity, toward = jnp.zeros(7), jax.jit(control.toward, static_argnums=4)
    errors = []
    for _ in range(60):
        pose, velocity = toward(pose, velocity, bad, port, PERIOD)
        errors.append(float(rcm.rcm_error(pose, port)))
    assert 0.005 < errors[15] < 0.02
    np.testing.assert_allclose(errors[-1], 0.02, atol=1e-4)


def test_the_roll_is_turned_no_faster_than_allowed():
    trocar = first_trocar()
    port = rcm.trocar_position(trocar, jnp.array([0.0, 0.0, 0.15]))
    pose, goal = (on_manifold(trocar, jnp.array([0.0, 0.0, 0.03]), roll) for roll in (-1.5, 1.5))
    velocity, toward = jnp.zeros(7), jax.jit(control.toward, static_argnums=4)
    spins = [0.0]
    for _ in range(40):
        pose, velocity = toward(pose, velocity, goal, port, PERIOD)
        spins.append(float(velocity[3]))
    assert np.abs(spins).max() <= control.MAX_SPIN * 1.001
    fastest = control.MAX_SPIN_ACCELERATION * PERIOD
    assert np.abs(np.diff(spins)).max() <= fastest * 1.001
    np.testing.assert_allclose(pose.R, goal.R, atol=1e-3)


def test_a_tool_leans_at_the_port_and_stays_at_its_tip():
    trocar = first_trocar()
    port = rcm.trocar_position(trocar, jnp.array([0.0, 0.0, 0.15]))
    pose = on_manifold(trocar, jnp.array([0.01, 0.02, 0.03]), 0.3)
    leant = control.corrected(pose, port, 2e-3 * pose.R[:, 0])
    np.testing.assert_array_equal(leant.p, pose.p)
    np.testing.assert_allclose(rcm.rcm_error(leant, port), 2e-3, rtol=1e-3)
    back = control.corrected(leant, port, -2e-3 * pose.R[:, 0])
    np.testing.assert_allclose(rcm.rcm_error(back, port), 0.0, atol=1e-5)


def test_a_load_that_stays_is_compensated_at_the_port_up_to_a_limit():
    trocar = first_trocar()
    port = rcm.trocar_position(trocar, jnp.array([0.0, 0.0, 0.15]))
    reference = on_manifold(trocar, jnp.array([0.01, 0.02, 0.03]), 0.3)
    hold = jax.jit(control.correct)

    def left_of(load, periods=30):
        lean = jnp.zeros(3)
        for _ in range(periods):
            measured = control.corrected(reference, port, lean + load * reference.R[:, 0])
            lean = hold(lean, measured, reference, port)
        return float(rcm.rcm_error(measured, port)), float(jnp.linalg.norm(lean))

    assert left_of(1e-3)[0] < 5e-6
    np.testing.assert_allclose(
        left_of(8e-3), (8e-3 - control.MAX_CORRECTION, control.MAX_CORRECTION), rtol=1e-2
    )
