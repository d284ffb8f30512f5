"""Suture throw: its start, its judge, the grasps of the point, and a rescuer that carries on."""

import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stubs

from starjax import rcm
from starjax.addons.suture import thread
from starjax.addons.suture.needle_drive import grasps
from starjax.addons.suture.needle_drive import task as driven
from starjax.addons.suture.suture_throw import expert, far_grasp, rescue, task
from starjax.addons.suture.tissue import needle as needles
from starjax.core.types import Pose
from starjax.sim import physics, scene
from starjax.sim.task import SimReadings
from starjax.tasks import wrist_script

TASK = task.TASK


@pytest.fixture(scope="module")
def start():
    """Returns bound, layout, readings and measurements at reset."""
    m = scene.compose(scene.name("suture_throw"))
    bound = TASK.bind(m)
    layout = task.sample(bound, jax.random.key(3))
    tips = Pose(jnp.asarray(task.R_BLOCK)[None], layout.tip[None])
    qpos, memory = task.begin(bound, layout, jnp.asarray(m.qpos0, jnp.float32), tips)
    no, still = jnp.zeros(1, bool), jnp.zeros((1, 3))
    contacts = physics.Contacts(jnp.zeros((1, 2), int), jnp.ones(1))
    readings = SimReadings(
        qpos, jnp.zeros(m.nv), tips, still, jnp.ones(1), no, contacts, memory, no[0]
    )
    return bound, layout, readings, task.measure(bound, layout, readings, None)


def test_needle_begins_in_the_block_and_leads_the_thread(start):
    bound, layout, readings, now = start
    assert bool(now.in_block) and not bool(now.drive.held)
    tail = needles.point_at(task.SIZE, now.drive.needle, jnp.asarray(-task.SIZE.end))
    np.testing.assert_allclose(now.thread.p[0], tail, atol=1e-6)
    np.testing.assert_allclose(thread.lengths(now.thread.p), thread.LINK, rtol=1e-4)
    p = np.asarray(now.thread.p)
    assert (p[:, 2] >= task.GROUND).all()
    assert (np.abs(p[:, :2]) < [0.036, 0.03]).all()  # the pad's half sizes
    point = needles.point_at(task.SIZE, now.drive.needle, jnp.asarray(task.SIZE.end))
    assert np.abs(point - np.array([0.0212, 0.0033, 0.005])).max() < 0.005  # in the block
    after = task.measure(bound, layout, readings, now)
    moved = np.abs(np.asarray(after.thread.p) - p).max(1)
    assert moved[0] == 0.0 and moved.max() < 0.005 and moved[-1] < 1e-4  # it hangs from the tail


def test_success_needs_every_condition(start):
    bound, layout, _, now = start
    yes = jnp.ones((), bool)
    drive = now.drive.replace(held=yes, has_exited=yes, exit_off=jnp.asarray(5e-4))
    done = now.replace(
        drive=drive, in_block=~yes, is_through=yes, by_point=yes, pulled=jnp.asarray(0.06)
    )
    found = task.status(bound, layout, done)
    assert bool(found.success_now) and float(found.reward) == 1.0
    assert TASK.stages[int(found.stage)] == "done"
    for worse in (
        done.replace(pulled=jnp.asarray(0.04)),
        done.replace(is_through=~yes),
        done.replace(drive=drive.replace(held=~yes)),
        done.replace(drive=drive.replace(collided=yes)),
        done.replace(drive=drive.replace(entry_off=jnp.asarray(2e-3))),
        done.replace(drive=drive.replace(exit_off=jnp.asarray(2e-3))),
        done.replace(drive=drive.replace(max_force=jnp.asarray(driven.MAX_FORCE))),
    ):
        assert not bool(task.status(bound, layout, worse).success_now)
    dropped = task.status(bound, layout, done.replace(drive=drive.replace(held=~yes)))
    assert bool(dropped.lost) and bool(dropped.loose)
    assert not bool(task.status(bound, layout, now).lost)


def test_the_reward_grows_while_the_needle_is_turned_out(start):
    bound, layout, _, now = start
    yes = jnp.ones((), bool)
    _, middle, end = expert.turns(layout.bite)

    def reward(turn):
        needle = needles.pose_on(task.SIZE, layout.bite, turn)
        drive = now.drive.replace(needle=needle, held=yes, is_inside=yes, has_exited=yes)
        moment = now.replace(drive=drive, in_block=~yes, by_point=yes)
        return float(task.status(bound, layout, moment).reward)

    rewards = [reward(turn) for turn in (0.5 * middle, middle, 0.95 * end)]
    assert min(np.diff(rewards)) > 0.02 and 4 / 6 < rewards[0] < rewards[-1] < 5 / 6


def test_the_point_is_turned_out_at_every_trocar_with_room_for_the_wrist():
    ref = np.array([slot.p_world_ref for slot in TASK.slots], np.float32)
    zero = np.zeros(1, np.float32)
    at = jax.vmap(lambda one: rcm.trocar_frame(one, ref, zero).p_world_trocar[0])(TASK.trocars)
    ways = np.linspace(*driven.DIRECTION, 4)

    def worst(p_trocar, way, length, leg):
        along = 0.5 * length * jnp.stack([jnp.cos(way), jnp.sin(way), 0.0])
        bite = needles.Bite(-along, along)
        turns = jnp.stack(expert.turns(bite))
        first, last = turns[leg], turns[leg + 1]
        held = jax.tree.map(lambda leaf: leaf[leg], far_grasp.grasps(task.SIZE))

        def angles(turn):
            tip = expert.tip_of(needles.pose_on(task.SIZE, bite, turn), held)
            return rcm.angles_through(wrist_script.WRIST, tip, p_trocar)

        return jnp.max(jnp.abs(jax.vmap(angles)(jnp.linspace(first, last, 20))))

    rows = [x.ravel() for x in np.meshgrid(range(len(at)), ways, task.BITES, range(2))]
    found = jax.jit(jax.vmap(worst))(
        at[rows[0]], *(jnp.asarray(x, jnp.float32) for x in rows[1:3]), jnp.asarray(rows[3])
    )
    assert np.rad2deg(found).max() < 77.0  # out of 80


NEAR, FIRST, SECOND, FREE = "as for driving", "first", "second", ""
BLOCK = {"in_block": True}
PICKED, INSIDE = {"held": True}, {"held": True, "is_inside": True}
OUT = {"is_inside": True, "has_exited": True, "emerged": expert.EMERGE}
TAKEN = {**OUT, "held": True, "by_point": True}
THROUGH = {"held": True, "by_point": True, "has_exited": True, "is_through": True}


@pytest.mark.parametrize(
    ("grip", "share", "height", "events", "phase", "leg"),
    [
        (FREE, -1.0, 0.06, BLOCK, expert.APPROACH, 0),
        (FREE, -1.0, 0.0, BLOCK, expert.BACK, 0),
        (NEAR, -2.0, 0.05, PICKED, expert.OVER, 0),
        (NEAR, -2.0, 0.0, PICKED, expert.LIFT, 0),
        (NEAR, -0.5, 0.0, INSIDE, expert.DRIVE, 0),
        (NEAR, 0.0, 0.0, {**OUT, "held": True}, expert.OPEN, 0),
        (FREE, 0.0, 0.0, OUT, expert.BACK, 0),
        (FREE, 0.0, 0.06, OUT, expert.AROUND, 0),
        (FREE, 1.0, 0.06, OUT, expert.AROUND, 1),
        (FIRST, 0.5, 0.0, TAKEN, expert.OUT, 0),
        (FIRST, 1.0, 0.0, TAKEN, expert.OPEN, 1),
        (SECOND, 1.0, 0.0, TAKEN, expert.OUT, 1),
        (SECOND, 1.8, 0.0, THROUGH, expert.PULL, 1),
    ],
)
def test_the_expert_carries_on_wherever_the_needle_is(
    start, grip, share, height, events, phase, leg
):
    """`share`: of the turn from the drive's end, 0, to the second grasp, 1."""
    _, layout, _, now = start
    out, middle, _ = expert.turns(layout.bite)
    needle = needles.pose_on(task.SIZE, layout.bite, out + share * (middle - out))
    far = far_grasp.grasps(task.SIZE)
    first, second = (jax.tree.map(lambda leaf, k=k: leaf[k], far) for k in range(2))
    held = {FIRST: first, SECOND: second}.get(grip, grasps.grasp(task.SIZE))
    tip = expert.tip_of(needle, held)
    tip = tip._replace(p=tip.p.at[2].add(height))
    # A needle in the jaws goes with them.
    needle = needle if grip == FREE else needle._replace(p=needle.p.at[2].add(height))
    events = {"in_block": False} | events
    ours = {name: jnp.asarray(x) for name, x in events.items() if hasattr(now, name)}
    drives = {name: jnp.asarray(x) for name, x in events.items() if name not in ours}
    now = now.replace(drive=now.drive.replace(needle=needle, tip=tip.p, **drives), **ours)
    state = stubs.one_tool(tip, now, layout)
    script = rescue.RESCUER.resume(jax.random.key(0), state)
    assert (int(script.phase), int(script.leg)) == (phase, leg)
    command, script, _ = rescue.RESCUER.act(script, state)
    assert float(jnp.linalg.norm(script.at - tip.p)) < 0.5e-3
    assert float(jnp.abs(script.R - tip.R).max()) < 0.02
    keeps = grip != FREE and phase != expert.OPEN
    assert (float(command.gripper[0]) == -1.0) == keeps


def test_a_needle_that_was_let_go_inside_is_taken_as_for_driving_and_driven_on(start):
    _, _, _, now = start
    yes, no = jnp.ones((), bool), jnp.zeros((), bool)

    def following(phase, held):
        drive = now.drive.replace(is_inside=yes, held=held, emerged=jnp.zeros(()))
        measurements = now.replace(drive=drive, in_block=no)
        script = types.SimpleNamespace(phase=jnp.asarray(phase))
        return int(expert._following(script, types.SimpleNamespace(measurements=measurements)))

    assert following(expert.DRIVE, yes) == expert.DRIVE
    assert following(expert.DRIVE, no) == expert.BACK
    assert following(expert.BACK, no) == expert.APPROACH
    assert following(expert.CLOSE, yes) == expert.DRIVE
    assert following(expert.CLOSE, no) == expert.APPROACH


def test_jaws_close_off_the_recorded_grasp_and_the_next_way_begins_there(start):
    _, layout, _, now = start
    tip = expert.tip_of(now.drive.needle, grasps.grasp(task.SIZE))
    now = now.replace(drive=now.drive.replace(held=jnp.ones((), bool), tip=tip.p))
    state = stubs.one_tool(tip, now, layout)
    script = expert.AGENT.init(jax.random.key(1), state)
    script = script.replace(R=tip.R, at=tip.p)
    script = expert.enter(script, jnp.asarray(expert.DESCEND, jnp.int32), state)
    assert float(jnp.abs(script.miss).max()) > 1e-4
    assert (np.abs(script.miss) <= np.array(expert.MISS)).all()
    state.gripper_target = state.gripper = jnp.ones(1)
    script = expert.enter(script, jnp.asarray(expert.CLOSE, jnp.int32), state)
    rough, closing, label = expert.AGENT.act(script, state)
    np.testing.assert_allclose(label.pose.p[0], tip.p, atol=1e-6)
    np.testing.assert_allclose(label.pose.R[0], tip.R, atol=1e-5)
    off = wrist_script.off(tip, closing.miss)
    np.testing.assert_allclose(rough.pose.p[0], off.p, atol=1e-6)
    np.testing.assert_allclose(rough.pose.R[0], off.R, atol=1e-5)
    lifting = expert.enter(closing, jnp.asarray(expert.LIFT, jnp.int32), state)
    np.testing.assert_allclose(lifting.start, off.p, atol=1e-6)
    np.testing.assert_allclose(lifting.R_from, off.R, atol=1e-6)


def test_the_state_shows_the_point_and_the_tip_from_the_needle(start):
    bound, layout, _, now = start
    seen = TASK.state(bound, layout, now)
    held, needle = grasps.grasp(task.SIZE), now.drive.needle
    tip = expert.tip_of(needle, held)
    found = np.asarray(TASK.relative(seen, tip.p[None])[9:]) * driven.NEAR
    point, bite = now.drive.point, layout.bite
    expected = [point - tip.p, point - bite.entry, point - bite.exit, -held.R.T @ held.p]
    np.testing.assert_allclose(found, np.concatenate(expected), atol=1e-6)
