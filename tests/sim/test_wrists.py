"""Experts in a scene whose tools have other wrists than those of the task."""

import types

import jax.numpy as jnp
import numpy as np
import pytest

from starjax import rcm
from starjax.core.types import Agent, Command, Pose
from starjax.sim import registries, scene, wrists
from starjax.sim import rescuer as rescue

REACH = registries.tasks.get("reach")
# Without a package, so its wrist is that of the record.
TASK = REACH._replace(
    name="bent", slots=tuple(slot._replace(tool="needle_driver") for slot in REACH.slots)
)
TROCAR = jnp.array([[0.02, -0.03, 0.15]])
TIP = Pose(jnp.diag(jnp.array([1.0, -1.0, -1.0]))[None], jnp.array([[-0.02, 0.01, 0.02]]))
STATE = types.SimpleNamespace(
    measured_trocar=types.SimpleNamespace(p_world_trocar=TROCAR), wrist=jnp.zeros((1, 2))
)


def shown(angles):
    """An expert that commands `TIP` with some wrist angles."""
    command = Command(TIP, jnp.ones(1), angles)
    return lambda: Agent(lambda key, state: (), lambda memory, state: (command, memory, command))


def held(tool, expert):
    task = TASK._replace(experts={"shown": expert})
    return wrists.holding(task, scene.name("reach", ["psm"], [tool]))


@pytest.mark.parametrize("part", (0, 2))
def test_an_expert_bends_the_wrist_of_the_tool_at_hand(part):
    angles = rcm.angles_through(rcm.LARGE_NEEDLE_DRIVER, TIP, TROCAR)
    command = held("prograsp", shown(angles)).expert().act((), STATE)[part]
    shaft = rcm.shaft_of(rcm.PROGRASP, command.pose, command.wrist)
    np.testing.assert_allclose(rcm.rcm_error(shaft, TROCAR), 0.0, atol=1e-6)
    np.testing.assert_allclose(command.pose.R, TIP.R, atol=1e-5)
    other = rcm.shaft_of(rcm.PROGRASP, TIP, angles)
    assert float(rcm.rcm_error(other, TROCAR)[0]) > 1e-4  # the same angles miss


def test_straight_commands_and_the_tasks_own_tool_leave_an_expert_as_it_is():
    straight = held("prograsp", shown(None)).expert().act((), STATE)[0]
    assert straight.wrist is None and straight.pose is TIP
    own = shown(jnp.zeros((1, 2)))
    assert held("needle_driver", own).experts["shown"] is own
    module = TASK.experts["default"].partition(":")[0]
    task = wrists.holding(TASK, scene.name("reach", ["psm"], ["prograsp"]))
    assert getattr(task.experts["default"], "__module__", "") == module


def test_an_expert_that_takes_over_bends_the_wrist_of_the_tool_at_hand(monkeypatch):
    angles = rcm.angles_through(rcm.LARGE_NEEDLE_DRIVER, TIP, TROCAR)
    agent = shown(angles)()
    written = rescue.Rescuer(agent.init, agent.act)
    one = types.SimpleNamespace(names=lambda: ["bent"], get=lambda name: TASK)
    monkeypatch.setattr(registries, "tasks", one)
    monkeypatch.setattr(registries, "rescuers", types.SimpleNamespace(get=lambda name: written))
    assert wrists.rescuer(TASK, "bent") is written
    task = wrists.holding(TASK, scene.name("reach", ["psm"], ["prograsp"]))
    fitted = wrists.rescuer(task, "bent")
    assert wrists.rescuer(task, "bent") is fitted  # else every round would compile
    command = fitted.act((), STATE)[0]
    shaft = rcm.shaft_of(rcm.PROGRASP, command.pose, command.wrist)
    np.testing.assert_allclose(rcm.rcm_error(shaft, TROCAR), 0.0, atol=1e-6)
    wrists._fitted_rescuer.cache_clear()
