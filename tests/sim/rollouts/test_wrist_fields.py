"""Wrist and shaft are recorded where a tool has them, and nowhere else."""

import types

import numpy as np
import pytest

from starjax import rcm
from starjax.core.types import Command, Observation
from starjax.sim.rollouts import episodes

FIELDS = {"wrist", "shaft_p", "shaft_R", "command_wrist"}
POSE = rcm.Pose(np.tile(np.eye(3), (2, 1, 1, 1)), np.zeros((2, 1, 3)))
ANGLES = np.full((2, 1, 2), 0.3)


def fields(shaft, measured, commanded):
    state = types.SimpleNamespace(
        coordinates=np.zeros((2, 4)),
        rcm_error=np.zeros((2, 1)),
        shaft=shaft,
        wrist=measured,
    )
    jaws = np.ones((2, 1))
    command = Command(POSE, jaws, commanded)
    step = episodes.Step(Observation(POSE, jaws), command, command, state, state)
    return episodes.DEMONSTRATION.fields(step)


def test_a_straight_tool_has_no_such_fields():
    assert not FIELDS & set(fields(None, None, None))


@pytest.mark.parametrize(("commanded", "recorded"), [(None, 0.0), (ANGLES - 0.1, 0.2)])
def test_a_wrist_has_them(commanded, recorded):
    found = fields(POSE, ANGLES, commanded)
    assert set(found) > FIELDS and all(episodes.what(name) for name in found)
    np.testing.assert_allclose(found["command_wrist"], recorded)
    np.testing.assert_allclose(found["wrist"], ANGLES)
