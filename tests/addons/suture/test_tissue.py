"""A needle driven by jaws on a given path: events, forces, energies; and the rows by themselves."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax.addons.suture.needle_drive import grasps, task
from starjax.addons.suture.tissue import driving, hole, prescribed, rows
from starjax.addons.suture.tissue import needle as needles
from starjax.addons.suture.tissue.needle import Bite
from starjax.core.types import Pose
from starjax.tasks import scripting

H = 1.0 / 240
SIZE = needles.CT1
BODY = driving.Body(np.array([1.83e-4] * 3 + [4.01e-6] * 3), 1.79e-4)
# Entry and exit off their marks (mm), largest force across the hole (N), work of the jaws (mJ).
FROZEN = [0.0053, 0.0489, 0.0205, 5.587]
BITE = Bite(jnp.array([0.005, 0.001, 0.0]), jnp.array([-0.006, 0.001, 0.0]))


@pytest.mark.parametrize("size", [needles.SH, needles.CT1])
def test_the_path_of_a_bite_passes_both_marks(size):
    half = needles.entry_angle(size, BITE)
    for turn, mark in ((-half, BITE.entry), (half, BITE.exit)):
        pose = needles.pose_on(size, BITE, turn)
        np.testing.assert_allclose(pose.R @ pose.R.T, np.eye(3), atol=1e-6)
        np.testing.assert_allclose(needles.point_at(size, pose, size.end), mark, atol=1e-7)
        np.testing.assert_allclose(needles.turn_on(size, BITE, pose), turn, atol=1e-6)
    pose = needles.pose_on(size, BITE, 0.4)
    p = needles.point_at(size, pose, jnp.asarray(-0.7))
    angle, distance, height = needles.coordinates(size, pose, p)
    np.testing.assert_allclose([angle, distance, height], [-0.7, size.radius, 0.0], atol=1e-6)
    step = needles.point_at(size, pose, jnp.asarray(-0.699)) - p
    np.testing.assert_allclose(
        step / 0.001 / size.radius, needles.tangent_at(pose, -0.7), atol=1e-3
    )


def test_the_velocity_after_a_step_minimises_the_cost():
    key = jax.random.split(jax.random.key(3), 5)
    count = 14
    J = jax.random.normal(key[0], (count, 6))
    stretch = 1e-3 * jax.random.normal(key[1], (count,))
    bound = 0.02 * jnp.where(jnp.arange(count) % 2 == 0, 1.0, jnp.inf)
    some = rows.ForceRows(
        J, stretch, jnp.full(count, 300.0), jnp.ones(count), -bound, bound, stretch
    )
    inertia = jnp.array([1e-3, 1e-3, 1e-3, 2e-3, 2e-3, 2e-3])
    free = jax.random.normal(key[2], (6,))
    u, forces = rows.solve(some, inertia, free, jnp.zeros(6), H)
    np.testing.assert_allclose(inertia * (u - free) / H, forces @ J, atol=2e-3)
    wanted = -(
        some.stiffness * (stretch + H * (J @ u - stretch)) + some.damping * (J @ u - stretch)
    )
    np.testing.assert_allclose(forces, np.clip(wanted, -bound, bound), rtol=1e-3, atol=1e-4)
    np.testing.assert_allclose(np.max(np.abs(forces)[::2]), 0.02, rtol=1e-5)


def test_a_spring_alone_is_the_implicit_one():
    J = jnp.eye(6)[:1]
    one = rows.made(J, 1e-3, 400.0, 1.0)
    m = 1e-4
    u, force = rows.solve(one, jnp.full(6, m), jnp.zeros(6).at[0].set(0.1), jnp.zeros(6), H)
    v = (m * 0.1 - H * 400.0 * 1e-3) / (m + H * (400.0 * H + 1.0))
    np.testing.assert_allclose(u[0], v, rtol=1e-5)
    np.testing.assert_allclose(force[0], m * (v - 0.1) / H, rtol=1e-4)


@pytest.mark.parametrize("scale", [1e-7, 1e-3, 1.0, 1e3])
def test_the_line_search_ends_at_the_minimum_however_near_it_is(scale):
    bends = jnp.array([0.5, 3.0, jnp.inf, 2.0]) * scale

    def slope(t):
        x = t / scale
        return 1e-3 * x + 2.0 * jnp.minimum(x, 0.5) + 1.5 * jnp.clip(x - 2.0, 0.0, 1.0)

    for first, found in ((-0.5, 0.25 / 1.0005), (-2.0, 2.0 + 0.998 / 1.501), (-3.0, 500.0)):
        end = rows.line_search(lambda t, first=first: slope(t) + first, jnp.asarray(first), bends)
        np.testing.assert_allclose(end / scale, found, rtol=1e-4)


@jax.jit
def carried(gripper, velocity):
    """Speeds (m/s) of a needle, and True while jaws that move `[3]` m/s hold it."""
    held, R = grasps.grasp(SIZE), jnp.diag(jnp.array([1.0, -1.0, -1.0]))
    pose = Pose(R @ held.R, jnp.array([0.0, 0.0, 0.05]) + R @ held.p)
    twist = jnp.concatenate([velocity, jnp.zeros(3)])[None]

    def tip(k):
        return Pose(R[None], jnp.array([[0.0, 0.0, 0.05]]) + k * H * velocity)

    def step(now, k):
        tissue, pose, u = now
        tips = driving.Tips(tip(k), twist, gripper[None])
        forces, tissue = driving.step(SIZE, BODY, tissue, pose, u, tips, H)
        u = u + H * (forces.needle + driving.weight(BODY)) / BODY.inertia
        turn = rows.rotation(H * u[3:])
        pose = Pose(pose.R @ turn, pose.p + H * u[:3])
        return (tissue, pose, u), (jnp.linalg.norm(u[:3]), tissue.patches.is_held[0])

    start = driving.begin(SIZE, tip(0.0), pose, jnp.ones(1, bool)), pose, jnp.zeros(6)
    return jax.lax.scan(step, start, jnp.arange(12.0))[1]


@pytest.mark.parametrize("gripper", [-0.02, -0.2, -1.0])
def test_jaws_carry_a_needle_at_their_own_speed_however_weakly_they_grip(gripper):
    ways = jax.random.normal(jax.random.key(0), (24, 3))
    velocity = 0.005 * ways / jnp.linalg.norm(ways, axis=1, keepdims=True)
    speed, is_held = jax.vmap(carried, (None, 0))(jnp.asarray(gripper), velocity)
    assert bool(is_held.all())
    assert float(speed.max()) < 0.015


@jax.jit
def driven(aside=0.0, gripper=-1.0):
    """Moves the jaws on the bite's path in 4 s, at its end `aside` m of it."""
    half = needles.entry_angle(SIZE, BITE)
    held = grasps.grasp(SIZE)

    def tip_at(t):
        s = jnp.clip(t / 4.0, 0.0, 1.0)
        s = scripting.sloped(s)
        needle = needles.pose_on(SIZE, BITE, -half - 0.2 + s * (2 * half + 0.5))
        R = needle.R @ held.R.T
        return Pose(R, needle.p - R @ held.p + s * jnp.array([0.0, aside, 0.0]))

    tips = jax.vmap(tip_at)(H * jnp.arange(1010))
    start = needles.pose_on(SIZE, BITE, -half - 0.2)
    return prescribed.run(SIZE, BODY, tips, start, gripper, H)


def last(moments):
    return jax.tree.map(lambda leaf: leaf[-1], moments)


@pytest.fixture(scope="module")
def straight():
    return driven()


def test_a_needle_on_its_arc_enters_and_leaves_at_the_marks(straight):
    pose, made = last(straight).pose, last(straight).tissue.hole
    assert made.has_exited and made.is_inside and not made.is_through
    assert np.linalg.norm(made.entry - BITE.entry) < 0.1e-3
    assert np.linalg.norm(made.exit - BITE.exit) < 0.2e-3
    assert float(made.max_force) < 0.25 * task.MAX_FORCE
    assert float(hole.emerged(SIZE, pose, made)) > task.EMERGED
    assert straight.tissue.patches.is_held.all()
    # In order: touched, pierced, left.
    events = straight.tissue.hole
    touches, inside, out = events.touches, events.is_inside, events.has_exited
    assert touches.any() and touches.argmax() < inside.argmax() < out.argmax()


def test_jaws_aside_of_the_arc_strain_the_hole():
    tissue = last(driven(aside=0.002)).tissue
    assert float(tissue.hole.max_force) > 2.0 * 0.25 * task.MAX_FORCE
    assert np.linalg.norm(tissue.hole.exit - BITE.exit) > task.ON_MARK


def test_the_jaws_do_work_and_the_pad_only_takes_it(straight):
    kinetic = 0.5 * np.sum(BODY.inertia * np.asarray(straight.u) ** 2, axis=1)
    lift = 2.0 * BODY.mass * 9.81 * SIZE.radius
    stored = 0.7**2 / hole.DIMPLE + 4 * 0.1**2 / hole.ACROSS
    done = H * np.cumsum(straight.power)
    assert (done + lift + stored > kinetic).all()
    # At least the friction and the cut along the path: lengths and forces of the module.
    half = float(needles.entry_angle(SIZE, BITE))
    path = 2.0 * half * SIZE.radius
    least = hole.CUT * path + 0.5 * hole.FRICTION * path**2
    assert 0.8 * least < done[-1] < 1.6 * least


def test_open_jaws_drop_a_needle_that_is_in_the_air():
    dropped = driven(gripper=1.0)
    assert not dropped.tissue.patches.is_held.any()
    np.testing.assert_array_equal(dropped.force, 0.0)


def test_a_drive_has_the_frozen_figures(straight):
    made = last(straight).tissue.hole
    figures = [
        1e3 * float(jnp.linalg.norm(made.entry - BITE.entry)),
        1e3 * float(jnp.linalg.norm(made.exit - BITE.exit)),
        float(made.max_force),
        1e3 * H * float(straight.power.sum()),
    ]
    np.testing.assert_allclose(figures, FROZEN, rtol=0.02, atol=0.002)
