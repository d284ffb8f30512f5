"""Needle regrasp: a tilted needle, a grasp as for driving, and an expert that finds it anywhere."""

import types

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import stubs

from starjax import rcm
from starjax.addons.suture.needle_regrasp import expert, rescue, task
from starjax.core.types import Pose
from starjax.sim import scene
from starjax.sim.task import Contacts, SimReadings
from starjax.tasks import wrist_script
from starjax.tasks.needle_pick import task as pick


@pytest.fixture(scope="module")
def model():
    return scene.compose(scene.name("needle_regrasp"))


@pytest.fixture(scope="module")
def bound(model):
    return task.bind(model)


@pytest.fixture(scope="module")
def layouts(bound):
    keys = jax.random.split(jax.random.key(0), 240)
    return jax.jit(jax.vmap(lambda key: task.sample(bound, key)))(keys)


def test_the_needle_lies_on_the_plate_at_any_yaw_and_tilt(model, bound, layouts):
    data = mujoco.MjData(model)
    tilts = []
    for k in range(0, 240, 20):
        layout = jax.tree.map(lambda x, k=k: x[k], layouts)
        data.qpos[:] = task.place_objects(bound, jnp.asarray(model.qpos0, jnp.float32), layout)
        mujoco.mj_kinematics(model, data)
        plate, needle = data.body("bed"), data.body("needle")
        normal = plate.xmat.reshape(3, 3)[:, 2]
        np.testing.assert_allclose(needle.xmat.reshape(3, 3)[:, 2], normal, atol=1e-5)
        above = (needle.xpos - plate.xpos) @ normal
        np.testing.assert_allclose(above, bound.pick.height, atol=1e-6)
        ctrl = task.drive(bound, layout, jnp.zeros(model.nu), jnp.zeros(()))
        np.testing.assert_array_equal(np.asarray(ctrl)[bound.ctrl], data.qpos[bound.bed])
        tilts.append(np.arccos(normal[2]))
    assert 0.4 < max(tilts) <= task.MAX_TILT + 1e-6
    yaw = np.arctan2(*np.asarray(layouts.needle.R)[:, 1::-1, 0].T)
    assert np.histogram(yaw, 6, (-np.pi, np.pi))[0].min() > 20


def measured(bound, layout, tip, height=0.03):
    """Measurements of a needle lifted by `height` that is held at `tip` in its rest frame."""
    up = jnp.array([0.0, 0.0, height])
    needle = layout.needle._replace(p=layout.needle.p + up)
    qpos = (
        jnp.zeros(40)
        .at[bound.pick.needle : bound.pick.needle + 7]
        .set(task.bodies.free_coords(needle))
    )
    pose = Pose(tip.R[None], tip.p[None] + up)
    no, one = jnp.zeros((1, 3)), jnp.ones(1)
    nothing = Contacts(jnp.zeros((1, 2), jnp.int32), one)
    readings = SimReadings(qpos, qpos, pose, no, one, jnp.ones(1, bool), nothing)
    return task.measure(bound, layout, readings, None)


@pytest.mark.parametrize(
    ("fraction", "turn", "is_strict"),
    [
        (1 / 3, 0.0, True),
        (1 / 3, 12.0, True),
        (1 / 3, 18.0, False),
        (1 / 3, 180.0, True),
        (0.28, 0.0, True),
        (0.2, 0.0, False),
        (0.5, 0.0, False),
    ],
)
def test_strict_is_a_square_grasp_a_third_from_the_swage(bound, layouts, fraction, turn, is_strict):
    layout = jax.tree.map(lambda x: x[7], layouts)
    angle = jnp.asarray((fraction - 0.5) * np.pi)
    x, z = task.wire_tangent(layout.needle, angle), -layout.needle.R[:, 2]
    R = jnp.stack([x, jnp.cross(z, x), z], -1) @ rcm.rotation_z(np.deg2rad(turn))
    found = measured(bound, layout, Pose(R, task.wire_point(layout.needle, angle)))
    np.testing.assert_allclose(found.fraction, fraction, atol=1e-4)
    skew = min(turn, 180.0 - turn)
    np.testing.assert_allclose(np.rad2deg(found.skew), skew, atol=0.1)
    status = task.status(bound, layout, found)
    assert bool(status.success_now) == is_strict and bool(status.loose)
    assert (float(status.reward) == 1.0) == is_strict


def test_a_needle_that_is_not_lifted_is_no_success(bound, layouts):
    layout = jax.tree.map(lambda x: x[7], layouts)
    angle = jnp.asarray(expert.GRASP_ANGLE)
    tip = Pose(layout.needle.R, task.wire_point(layout.needle, angle))
    status = task.status(bound, layout, measured(bound, layout, tip, height=0.5 * pick.LIFT))
    assert not status.success_now and not status.loose and 0 <= float(status.reward) < 1


def test_the_grasp_is_within_the_wrist_at_every_trocar(layouts):
    """It needs a wrist: a straight tool misses it by tens of degrees."""
    p_trocar = np.asarray(rcm.trocar_position(rcm.TROCARS, np.array([0.0, 0.0, 0.15])))
    p_trocar = p_trocar[np.arange(240) % 12].astype(np.float32)

    @jax.jit
    @jax.vmap
    def grasp(needle, o):
        frame = types.SimpleNamespace(p_world_trocar=o[None], roll_zero=jnp.zeros(1))
        measurements = types.SimpleNamespace(pick=types.SimpleNamespace(needle=needle))
        state = types.SimpleNamespace(measured_trocar=frame, measurements=measurements)
        pose = expert._grasp(state)
        found = rcm.through(wrist_script.WRIST, pose, o)
        along = jnp.arccos(pose.R[:, 2] @ (pose.p - o) / jnp.linalg.norm(pose.p - o))
        return found.is_feasible, jnp.abs(found.wrist), along

    feasible, angles, straight = grasp(layouts.needle, p_trocar)
    assert feasible.all() and np.rad2deg(angles.max()) < 75.0
    assert np.rad2deg(np.median(straight)) > 15.0


@pytest.mark.parametrize(
    ("angle", "turn", "height", "phase"),
    [
        (expert.GRASP_ANGLE, 0.0, 0.0, expert.LIFT),
        (expert.GRASP_ANGLE, 0.0, 0.03, expert.HOLD),
        (expert.GRASP_ANGLE, 0.4, 0.0, expert.RAISE),
        (0.5, 0.0, 0.03, expert.APPROACH),
    ],
)
def test_the_expert_lifts_a_needle_that_is_held_for_driving_and_lets_any_other_go(
    bound, layouts, angle, turn, height, phase
):
    layout = jax.tree.map(lambda x: x[3], layouts)
    p = task.wire_point(layout.needle, jnp.asarray(angle))
    x, z = task.wire_tangent(layout.needle, jnp.asarray(angle)), -layout.needle.R[:, 2]
    R = jnp.stack([x, jnp.cross(z, x), z], -1) @ rcm.rotation_z(jnp.asarray(turn))
    tip = Pose(R, p)
    now = measured(bound, layout, tip, height)
    tip = tip._replace(p=p.at[2].add(height))
    state = stubs.one_tool(tip, now, layout)
    script = rescue.RESCUER.resume(jax.random.key(0), state)
    assert int(script.phase) == phase and float(script.jaws) == -1.0
    command, _, _ = rescue.RESCUER.act(script, state)
    assert float(jnp.linalg.norm(command.pose.p[0] - tip.p)) < 0.5e-3
    is_kept = phase in (expert.LIFT, expert.HOLD)
    assert (float(command.gripper[0]) == -1.0) == is_kept


@pytest.mark.parametrize(
    ("turn", "low", "phase", "least"),
    [(0.0, 0.0, expert.LIFT, expert.LIFT_HEIGHT), (0.0, 0.01, expert.LIFT, 0.033),
     (0.0, -0.03, expert.HOLD, 0.0), (0.4, -0.03, expert.RAISE, 0.0)],
)  # fmt: skip
def test_a_rescued_needle_is_lifted_high_enough_and_let_go_if_it_is_askew(
    bound, layouts, turn, low, phase, least
):
    """`low`: m that the needle lies lower than at first. `least`: m, how far the tip goes up."""
    layout = jax.tree.map(lambda x: x[3], layouts)
    angle = jnp.asarray(expert.GRASP_ANGLE)
    x, z = task.wire_tangent(layout.needle, angle), -layout.needle.R[:, 2]
    square = Pose(jnp.stack([x, jnp.cross(z, x), z], -1), task.wire_point(layout.needle, angle))
    fallen = square._replace(p=square.p.at[2].add(-low))
    state = stubs.one_tool(fallen, measured(bound, layout, square, -low), layout)
    script = rescue.RESCUER.resume(jax.random.key(0), state)
    assert int(script.phase) == (expert.LIFT if low >= 0.0 else expert.HOLD)
    R = square.R @ rcm.rotation_z(jnp.asarray(turn))
    askew = measured(bound, layout, Pose(R, square.p), -low)
    state = stubs.one_tool(fallen._replace(R=R), askew, layout)
    command, script, _ = rescue.RESCUER.act(script, state)
    assert int(script.phase) == phase and (float(command.gripper[0]) == -1.0) == (turn == 0.0)
    off = float(square.p[2] - layout.needle.p[2])  # offset of the wire from the centre
    up = float(script.goal[2] - fallen.p[2])
    assert up >= least - off - 1e-6


def test_a_needle_on_its_other_side_is_taken_from_above(layouts):
    needle = jax.tree.map(lambda x: x[3], layouts.needle)
    over = needle._replace(R=needle.R @ jnp.diag(jnp.array([1.0, -1.0, -1.0])))
    frame = stubs.measured_above()
    for pose in (needle, over):
        measurements = types.SimpleNamespace(pick=types.SimpleNamespace(needle=pose))
        state = types.SimpleNamespace(measured_trocar=frame, measurements=measurements)
        grasp = expert._grasp(state)
        np.testing.assert_allclose(grasp.R[:, 2], -needle.R[:, 2], atol=1e-6)
        along = task.wire_tangent(pose, jnp.asarray(expert.GRASP_ANGLE))
        np.testing.assert_allclose(abs(grasp.R[:, 0] @ along), 1.0, atol=1e-6)
