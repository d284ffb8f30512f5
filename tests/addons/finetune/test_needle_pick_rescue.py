"""The rescuer of needle pick puts a needle down that its point holds, and lifts any other."""

import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stubs

from starjax import rcm
from starjax.addons.finetune.rescuers import needle_pick as rescue
from starjax.core.types import Pose
from starjax.tasks import phases
from starjax.tasks.needle_pick import expert

GROUND, HEIGHT = 0.0005, 0.03  # m, of the resting and of the lifted needle
FRAME = rcm.trocar_frame(rcm.Trocar(*jnp.zeros((3, 1))), jnp.array([[0.0, 0.0, 0.15]]))


def state_of(height, sticks, touch=True):
    """State of a tool at a segment of the needle, its jaws commanded to close."""
    p = jnp.array([0.01, -0.02, GROUND + height])
    tip = p + jnp.asarray(expert.MIDDLES[5])
    pose, _ = rcm.ACTION_SPACES["rcm4"].decode(jnp.append(0.3, tip)[None], FRAME)
    needle = Pose(jnp.eye(3), p)
    found = types.SimpleNamespace(needle=needle, touch=jnp.array(touch), sticks=jnp.array(sticks))
    lying = types.SimpleNamespace(needle=needle._replace(p=p.at[2].set(GROUND)))
    state = stubs.one_tool(Pose(pose.R[0], tip), found, lying)
    state.measured_trocar, state.touch, state.wrist = FRAME, jnp.array([touch]), None
    state.velocity = jnp.zeros((1, 7))
    return state


@pytest.mark.parametrize(
    ("height", "sticks", "touch", "phase"),
    [
        (HEIGHT, False, True, expert.HOLD),
        (0.0, False, True, expert.LIFT),
        (HEIGHT, True, True, rescue.PUT),
        (0.0, True, True, rescue.PUT),
        (0.0, False, False, phases.RAISE),
    ],
)
def test_the_phase_follows_from_the_grasp(height, sticks, touch, phase):
    script = rescue.RESCUER.resume(jax.random.key(0), state_of(height, sticks, touch))
    assert int(script.phase) == phase


def test_a_needle_held_by_its_point_is_on_the_ground_before_the_jaws_open():
    state = state_of(HEIGHT, sticks=True)
    tip, act = state.pose.p[0], jax.jit(lambda script: rescue.RESCUER.act(script, state))
    script = rescue.RESCUER.resume(jax.random.key(0), state)
    seen = []
    while int(script.phase) >= rescue.PUT:
        _, script, label = act(script)
        seen.append((float(label.pose.p[0, 2]), float(label.gripper[0]), int(script.phase)))
    z, jaws, phase = np.array(seen[:-1]).T
    assert (jaws[phase == rescue.PUT] == -1.0).all() and abs(z[0] - float(tip[2])) < 1e-3
    np.testing.assert_allclose(z[phase == rescue.FREE], GROUND + expert.GRASP_ABOVE, atol=1e-4)
    assert jaws[-1] == 1.0 and int(script.phase) == phases.RAISE
    np.testing.assert_allclose(label.pose.p[0, :2], tip[:2], atol=1e-3)


@pytest.mark.parametrize(
    ("off", "phase"),
    [
        ((0.0, 0.0, 0.012), phases.DESCEND),
        ((0.0, 0.0, 0.0002), expert.CLOSE),
        ((0.0, 0.04, 0.012), phases.RAISE),
        ((0.0, 0.0, 0.05), phases.APPROACH),
    ],
)
def test_open_jaws_above_the_wire_come_down(off, phase):
    state = state_of(0.0, sticks=False, touch=False)
    tip = state.pose.p + jnp.array(off) + jnp.array([0.0, 0.0, expert.GRASP_ABOVE])
    state.pose, state.gripper_target = state.pose._replace(p=tip), jnp.ones(1)
    # Above the pads' height any roll will do; at the wire jaws are along its normal.
    normal = jnp.cross(jnp.asarray(expert.TANGENTS)[5], jnp.array([0.0, 0.0, 1.0]))
    R = state.pose.R.at[0, :, 1].set(normal)
    state.pose = state.pose._replace(R=R)
    script = rescue.RESCUER.resume(jax.random.key(0), state)
    assert int(script.phase) == phase
    if phase == phases.DESCEND:
        assert int(script.segment) == 5 and float(script.goal[2]) < float(tip[0, 2])
