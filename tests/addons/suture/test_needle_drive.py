"""Needle drive: marks, grasp, strict success, and a rescuer that finishes any drive."""

import functools
import itertools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import stubs

from starjax import rcm
from starjax.addons.suture.needle_drive import expert, grasps, rescue, task
from starjax.addons.suture.tissue import driving, hole
from starjax.addons.suture.tissue import needle as needles
from starjax.core.types import Pose
from starjax.sim import scene
from starjax.sim.task import Contacts, SimReadings
from starjax.tasks import wrist_script

TASKS = {"needle_drive": task.TASK, "needle_drive_sh": task.SMALL}


@functools.cache
def compiled(name):
    model = scene.compose(scene.name(name))
    return model, TASKS[name].bind(model)


def layouts(name, count=240):
    keys = jax.random.split(jax.random.key(0), count)
    return jax.jit(jax.vmap(lambda key: TASKS[name].sample(compiled(name)[1], key)))(keys)


@pytest.mark.parametrize("name", TASKS)
def test_the_needle_is_that_of_the_model(name):
    model, bound = compiled(name)
    size, data = bound.size, mujoco.MjData(model)
    data.qpos[bound.needle : bound.needle + 7] = [0, 0, 0, 1, 0, 0, 0]
    mujoco.mj_kinematics(model, data)
    ends = np.linspace(-size.end, size.end, needles.SEGMENTS + 1)
    for k, (a, b) in enumerate(itertools.pairwise(ends)):
        middle = (needles.offset_at(size, jnp.asarray(x)) for x in (a, b))
        np.testing.assert_allclose(data.geom(f"wire{k}").xpos, sum(middle) / 2, atol=1e-6)
        np.testing.assert_allclose(model.geom(f"wire{k}").size[0], size.wire)
    chord = 2 * size.radius * np.sin(size.sweep / needles.SEGMENTS / 2)
    mass = np.pi * size.wire**2 * needles.STEEL * needles.SEGMENTS * chord
    np.testing.assert_allclose(model.body("needle").mass[0], mass, rtol=1e-4)
    np.testing.assert_allclose(bound.body.inertia[:3], mass + 4e-6, rtol=1e-4)


@pytest.mark.parametrize("name", TASKS)
def test_marks_are_as_far_apart_as_the_task_says(name):
    bite = layouts(name).bite
    along = np.asarray(bite.exit - bite.entry)
    apart = np.linalg.norm(along, axis=1)
    low, high = {"needle_drive": (0.008, 0.014), "needle_drive_sh": (0.008, 0.009)}[name]
    assert low <= apart.min() < low + 0.0005 and high - 0.0005 < apart.max() <= high
    way = np.arctan2(along[:, 1], along[:, 0]) % (2 * np.pi)
    assert task.DIRECTION[0] <= way.min() and way.max() <= task.DIRECTION[1]


@pytest.mark.parametrize("name", TASKS)
def test_the_near_camera_has_both_marks_in_every_crop_at_three_pixels_per_millimetre(name):
    camera, bite = compiled(name)[0].camera("camera_near"), layouts(name).bite
    R = np.zeros(9)
    mujoco.mju_quat2Mat(R, camera.quat)
    seen = (np.concatenate([bite.entry, bite.exit]) - camera.pos) @ R.reshape(3, 3)
    half = np.tan(np.deg2rad(camera.fovy[0]) / 2)
    assert np.abs(seen[:, :2] / seen[:, 2:]).max() < 0.8 * half  # in crops of 90%
    pixel = 2 * half * np.abs(seen[:, 2]) / 128
    assert pixel.max() < 0.001 / 3


@pytest.mark.parametrize("name", TASKS)
def test_one_grasp_is_within_the_wrist_at_every_trocar(name):
    found = layouts(name)
    _, bound = compiled(name)
    p_trocar = np.asarray(rcm.trocar_position(rcm.TROCARS, np.array([0.0, 0.0, 0.15])))
    p_trocar = p_trocar[np.arange(240) % 12].astype(np.float32)
    held = grasps.grasp(bound.size)

    @jax.jit
    @jax.vmap
    def angles(bite, o):
        half = needles.entry_angle(bound.size, bite)
        end = half + expert.EMERGE / bound.size.radius

        def at(share):
            turn = -half - expert.BEFORE + share * (end + half + expert.BEFORE)
            tip = wrist_script.tip_of(needles.pose_on(bound.size, bite, turn), held)
            return rcm.angles_through(wrist_script.WRIST, tip, o)

        return jax.vmap(at)(jnp.linspace(0.0, 1.0, 9))

    assert np.rad2deg(np.abs(angles(found.bite, p_trocar)).max()) < 79.0


def measured(bound, layout, entry=0.0, out=0.0, force=0.1, emerged=0.004, collided=False):
    """Measurements of a driven needle: entry and exit off by so much, m."""
    size, bite = bound.size, layout.bite
    turn = needles.entry_angle(size, bite) + emerged / size.radius
    pose = needles.pose_on(size, bite, turn)
    aside = jnp.array([0.0, 1.0, 0.0])
    made = hole.none().replace(
        is_inside=jnp.ones((), bool),
        has_exited=jnp.ones((), bool),
        entry=bite.entry + entry * aside,
        exit=bite.exit + out * aside,
        max_force=jnp.asarray(force),
    )
    tip = wrist_script.tip_of(pose, grasps.grasp(size))
    tips = Pose(tip.R[None], tip.p[None])
    tissue = driving.begin(size, tips, pose, jnp.ones(1, bool)).replace(hole=made)
    qpos = jnp.zeros(40)
    coords = task.bodies.free_coords(pose)
    qpos = qpos.at[bound.needle : bound.needle + 7].set(coords)
    no, one = jnp.zeros((1, 3)), jnp.ones(1)
    nothing = Contacts(jnp.zeros((1, 2), jnp.int32), one)
    readings = SimReadings(
        qpos, qpos, tips, no, one, jnp.zeros(1, bool), nothing, tissue, jnp.asarray(collided)
    )
    return task.measure(bound, layout, readings, None)


@pytest.mark.parametrize(
    ("case", "is_strict"),
    [
        ({}, True),
        ({"entry": 0.0009, "out": 0.0009}, True),
        ({"entry": 0.0011}, False),
        ({"out": 0.0011}, False),
        ({"force": 0.41}, False),
        ({"emerged": 0.0025}, False),
        ({"collided": True}, False),
    ],
)
def test_strict_is_on_both_marks_gently_and_out(case, is_strict):
    _, bound = compiled("needle_drive")
    layout = jax.tree.map(lambda x: x[3], layouts("needle_drive"))
    status = task.status(bound, layout, measured(bound, layout, **case))
    assert bool(status.success_now) == is_strict and bool(status.loose) and not status.lost
    assert (float(status.reward) == 1.0) == is_strict


def at(bound, layout, turn, height=0.0, **events):
    """A state of a needle on its path at `turn` rad, lifted by `height` m, its tip unchanged."""
    pose = needles.pose_on(bound.size, layout.bite, jnp.asarray(turn))
    pose = pose._replace(p=pose.p.at[2].add(height))
    tip = wrist_script.tip_of(pose, grasps.grasp(bound.size))
    now = measured(bound, layout).replace(needle=pose, tip=tip.p, **events)
    return stubs.one_tool(tip, now, layout)


NO, YES, FAR = jnp.zeros((), bool), jnp.ones((), bool), jnp.asarray(0.004)


@pytest.mark.parametrize(
    ("turn", "height", "events", "phase"),
    [
        (-1.0, 0.0, {"is_inside": NO, "has_exited": NO, "emerged": 0 * FAR}, expert.RAISE),
        (-1.0, 0.03, {"is_inside": NO, "has_exited": NO, "emerged": 0 * FAR}, expert.APPROACH),
        (0.1, 0.0, {"is_inside": YES, "has_exited": NO, "emerged": 0 * FAR}, expert.DRIVE),
        (0.1, 0.001, {"is_inside": YES, "has_exited": NO, "emerged": 0 * FAR}, expert.DRIVE),
        (0.9, 0.0, {"is_inside": YES, "has_exited": YES, "emerged": FAR}, expert.HOLD),
    ],
)
def test_the_expert_enters_anywhere_without_a_jolt(turn, height, events, phase):
    _, bound = compiled("needle_drive")
    layout = jax.tree.map(lambda x: x[3], layouts("needle_drive"))
    state = at(bound, layout, turn, height, **events)
    script = rescue.RESCUER.resume(jax.random.key(0), state)
    assert int(script.phase) == phase and float(script.jaws) == -1.0
    command, _, _ = rescue.RESCUER.act(script, state)
    assert float(jnp.linalg.norm(command.pose.p[0] - state.pose.p[0])) < 0.5e-3
    assert float(jnp.abs(command.pose.R[0] - state.pose.R[0]).max()) < 0.02
    np.testing.assert_array_equal(command.gripper, -1.0)


def test_a_needle_off_its_path_is_back_on_it_at_the_end_of_the_drive():
    _, bound = compiled("needle_drive")
    layout = jax.tree.map(lambda x: x[3], layouts("needle_drive"))
    events = {"is_inside": YES, "has_exited": NO, "emerged": 0 * FAR}
    state = at(bound, layout, 0.1, 0.001, **events)
    script = rescue.RESCUER.resume(jax.random.key(0), state)
    first, end = (
        expert._on_arc(bound.size, script, jnp.asarray(share), state) for share in (0.0, 1.0)
    )
    np.testing.assert_allclose(first.p, state.pose.p[0], atol=1e-6)
    path = needles.pose_on(bound.size, layout.bite, expert._end(bound.size, state))
    np.testing.assert_allclose(end.p, wrist_script.tip_of(path, script.held).p, atol=1e-6)
