"""The dial of needle drive: turns, grasps at any angle, and a plane that suits the trocar."""

import functools
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax import rcm
from starjax.addons.suture.needle_drive import dial, expert, grasps, rescue
from starjax.addons.suture.tissue import needle as needles
from starjax.core.types import Pose
from starjax.tasks import wrist_script

COUNT = 200
P_TROCARS = np.asarray(rcm.trocar_position(rcm.TROCARS, np.float32([0.0, 0.0, 0.15])))


@functools.cache
def layouts():
    return jax.jit(jax.vmap(lambda key: dial.TASK.sample(None, key)))(
        jax.random.split(jax.random.key(0), COUNT)
    )


def a_layout(turn_deg):
    """Returns the first layout with a bite of this turn."""
    first = jax.tree.map(lambda leaf: leaf[0], layouts())
    middle = 0.5 * (first.bite.entry + first.bite.exit)
    along = first.bite.exit - first.bite.entry
    half = 0.5 * (np.deg2rad(turn_deg) - dial.AROUND)
    reach = dial.SIZE.radius * np.sin(half) * along / jnp.linalg.norm(along)
    return first.replace(bite=needles.Bite(middle - reach, middle + reach))


@functools.cache
def margins():
    """Returns degrees to the wrist's limits `[COUNT, trocars, leans]`."""

    def of(bite, p_trocar, lean):
        return dial.margin(bite, p_trocar, lean)

    each = jax.vmap(of, (None, None, 0))
    each = jax.vmap(jax.vmap(each, (None, 0, None)), (0, None, None))
    return np.rad2deg(jax.jit(each)(layouts().bite, P_TROCARS, jnp.asarray(dial.LEANS)))


def test_turns_fill_the_dial_and_its_bins():
    turn = np.rad2deg(jax.vmap(dial.turn_of)(layouts().bite))
    bins = np.asarray(jax.vmap(dial.label)(layouts())["turn"])
    assert 83.99 < turn.min() < 86 and 148 < turn.max() < 150.01
    np.testing.assert_array_equal(bins, np.clip((turn - 84.0) // 11.0, 0, dial.BINS - 1))
    assert np.bincount(bins).min() > 15 and len(np.bincount(bins)) == dial.BINS


@pytest.mark.parametrize("turn", [90.0, 145.0])
def test_the_grasp_is_that_of_needle_drive_at_another_angle(turn):
    bite = a_layout(turn).bite
    angle = -float(needles.entry_angle(dial.SIZE, bite))
    expected = grasps.grasp(dial.SIZE, angle, dial.GRASP_TURN, dial.GRASP_LEAN)
    found = dial.grasp(bite)
    np.testing.assert_allclose(found.R, expected.R, atol=1e-6)
    np.testing.assert_allclose(found.p, expected.p, atol=1e-8)


@pytest.mark.parametrize("lean", [-0.7, 0.0, 0.4])
def test_the_arc_passes_both_marks_in_any_plane(lean):
    bite = a_layout(110.0).bite
    half, up = needles.entry_angle(dial.SIZE, bite), dial.up_of(bite, jnp.asarray(lean))
    for turn, mark in ((-half, bite.entry), (half, bite.exit)):
        pose = needles.pose_on(dial.SIZE, bite, turn, up)
        point = needles.point_at(dial.SIZE, pose, jnp.asarray(dial.SIZE.end))
        np.testing.assert_allclose(point, mark, atol=1e-7)
        np.testing.assert_allclose(needles.turn_on(dial.SIZE, bite, pose, up), turn, atol=1e-6)
    normal = needles.pose_on(dial.SIZE, bite, half, up).R[:, 2]
    assert abs(np.arcsin(normal[2])) == pytest.approx(abs(lean), abs=1e-6)


def test_one_plane_serves_every_trocar_until_the_dial_turns_far():
    turn = np.rad2deg(jax.vmap(dial.turn_of)(layouts().bite))
    one = margins()[:, :, np.argmin(np.abs(dial.LEANS - dial.LEAN))].min(1) > 0
    any_one, own = margins().min(1).max(1) > 0, (margins().max(2) > 0).mean(1)
    assert one[turn < 117].all() and not one[turn > 128].any()
    assert not any_one[turn > 133].any() and own[turn < 128].min() == 1.0
    assert 0.5 < own[turn > 139].mean() < 0.9


def test_the_expert_changes_its_lean_for_the_trocar_alone():
    @jax.jit
    def leaned(layout, p_trocar):
        """Returns the expert's lean, and how much margin it gains (rad)."""
        told = types.SimpleNamespace(p_world_trocar=p_trocar[None])
        up = dial.plane(types.SimpleNamespace(layout=layout, measured_trocar=told))
        along = layout.bite.exit - layout.bite.entry
        side = jnp.cross(jnp.asarray(needles.VERTICAL), along / jnp.linalg.norm(along))
        lean = jnp.arcsin(up @ side)
        margin = [dial.margin(layout.bite, p_trocar, x) for x in (lean, jnp.asarray(dial.LEAN))]
        return lean, margin[0] - margin[1]

    near, far = (np.array([leaned(a_layout(t), p) for p in P_TROCARS]) for t in (105.0, 140.0))
    np.testing.assert_allclose(near[:, 0], dial.LEAN, atol=1e-6)
    assert np.ptp(far[:, 0]) > np.deg2rad(14.0)
    assert far[:, 1].min() > -1e-5 and far[:, 1].max() > np.deg2rad(3.0)


def in_the_pad(turn, trocar, lean):
    """A state of a needle that another agent has driven to `turn` rad in a plane with `lean`."""
    layout = a_layout(140.0)
    needle = needles.pose_on(
        dial.SIZE, layout.bite, jnp.asarray(turn), dial.up_of(layout.bite, lean)
    )
    tip = wrist_script.tip_of(needle, dial.grasp(layout.bite))
    now = {
        "needle": needle,
        "tip": tip.p,
        "is_inside": jnp.ones((), bool),
        "emerged": jnp.zeros(()),
    }
    return types.SimpleNamespace(
        pose=Pose(tip.R[None], tip.p[None]),
        measurements=types.SimpleNamespace(**now),
        layout=layout,
        measured_trocar=types.SimpleNamespace(p_world_trocar=jnp.asarray(P_TROCARS[trocar])[None]),
        gripper_target=-jnp.ones(1),
        gripper=-0.5 * jnp.ones(1),
        touch=jnp.ones(1, bool),
        step=jnp.asarray(50),
    )


@pytest.mark.parametrize(
    ("rescuer", "plane"),
    [(rescue.DIAL, dial.plane), (rescue.DIAL_ONE_PLANE, dial.one_plane)],
)
@pytest.mark.parametrize("trocar", [0, 11])
def test_a_needle_in_another_plane_ends_in_the_experts(rescuer, plane, trocar):
    state = in_the_pad(0.1, trocar, jnp.asarray(0.3))
    script = rescuer.resume(jax.random.key(0), state)
    command, _, _ = rescuer.act(script, state)
    assert int(script.phase) == expert.DRIVE and float(script.jaws) == -1.0
    assert float(jnp.linalg.norm(command.pose.p[0] - state.pose.p[0])) < 0.5e-3
    assert float(jnp.abs(command.pose.R[0] - state.pose.R[0]).max()) < 0.02
    end = expert._on_arc(dial.SIZE, script, jnp.ones(()), state, plane)
    turn, up, bite = expert._end(dial.SIZE, state), plane(state), state.layout.bite
    begun = needles.turn_on(dial.SIZE, bite, state.measurements.needle, up)
    np.testing.assert_allclose(script.turn, begun, atol=1e-6)
    path = needles.pose_on(dial.SIZE, bite, turn, up)
    np.testing.assert_allclose(end.R, wrist_script.tip_of(path, script.held).R, atol=1e-5)
