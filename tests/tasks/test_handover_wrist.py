"""Hand-over's expert with wrists: its tips are the same at every trocar, its jaws open level."""

import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax import rcm
from starjax.core.types import Pose
from starjax.tasks import scripting, two_arms
from starjax.tasks.needle_handover import expert_wrist, task
from starjax.tasks.wrist_script import WRIST

REFS = np.array([slot.p_world_ref for slot in two_arms.SLOTS], np.float32)
ZEROS = np.array([slot.roll_zero for slot in two_arms.SLOTS], np.float32)
PASSED = jnp.array([[-0.004, 0.0, 0.04], [0.004, 0.003, 0.04]])  # m, tips at the hand-over
ROLLS = jnp.array([0.4, -0.3])


@pytest.fixture(scope="module")
def commands():
    """(trocars, step, tips) -> frames, commands and those of straight wrists, `[N, 2]` each."""

    def one(trocar, step, tips):
        frame = rcm.trocar_frame(trocar, REFS, ZEROS)
        state = types.SimpleNamespace(measured_trocar=frame, step=step, wrist=jnp.zeros((2, 2)))
        command = expert_wrist.PLAY.command(ROLLS, tips, jnp.ones(2), state)
        return frame, command, scripting.command(ROLLS, tips, jnp.ones(2), state)

    return jax.jit(jax.vmap(one, (0, None, None)))


@pytest.mark.parametrize("tips", [PASSED, jnp.array(task.PARK)])
def test_no_trocar_moves_a_tip_and_every_shaft_passes_its_own(commands, tips):
    frame, command, _ = commands(two_arms.TROCARS, 300, tips)
    np.testing.assert_allclose(command.pose.p, jnp.broadcast_to(tips, (12, 2, 3)), atol=1e-6)
    np.testing.assert_allclose(command.pose.R, command.pose.R[:1].repeat(12, 0), atol=1e-5)
    shaft = rcm.shaft_of(WRIST, command.pose, command.wrist)
    assert float(rcm.rcm_error(shaft, frame.p_world_trocar).max()) < 1e-6
    np.testing.assert_allclose(command.pose.R[..., 2, 1], 0.0, atol=1e-6)  # the jaws open level


def test_the_first_command_has_a_straight_wrist(commands):
    _, command, straight = commands(two_arms.TROCARS, 0, jnp.array(task.PARK))
    np.testing.assert_allclose(command.pose.R, straight.pose.R, atol=1e-5)
    np.testing.assert_allclose(command.wrist, 0.0, atol=1e-4)


def test_a_roll_turns_the_jaws_to_a_level_direction():
    """`scripting.turn_to` of the tips at roll 0 finds the roll whose jaws open along a normal."""
    trocar = jax.tree.map(lambda field: jnp.asarray(field[-1]), two_arms.TROCARS)
    state = types.SimpleNamespace(
        measured_trocar=rcm.trocar_frame(trocar, REFS, ZEROS), step=300, wrist=jnp.zeros((2, 2))
    )
    angle = jnp.array([-1.2, -2.0])
    normal = jnp.stack([jnp.cos(angle), jnp.sin(angle), jnp.zeros(2)], -1)

    def pose(roll) -> Pose:
        return expert_wrist.PLAY.command(roll, PASSED, jnp.ones(2), state).pose

    roll = scripting.turn_to(normal, pose(jnp.zeros(2)).R)
    along = jnp.sum(pose(roll).R[:, :, 1] * normal, -1)
    np.testing.assert_allclose(jnp.abs(along), 1.0, atol=1e-5)
