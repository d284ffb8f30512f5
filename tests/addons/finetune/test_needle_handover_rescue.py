"""The rescuer of needle hand-over continues where the tools are and sees a miss before the drop."""

import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax import rcm
from starjax.addons.finetune.rescuers import needle_handover as rescue
from starjax.core.types import Pose
from starjax.tasks.needle_handover import expert

START = jnp.array([-0.024, 0.0, 0.001])  # m, of the needle
OPEN, EMPTY, FULL = 1.0, -0.8, -0.5  # measured openings
SEGMENTS = (1, 4)  # the giver's and the taker's
AT = expert.MIDDLES[list(SEGMENTS)]


def state_of(taker, touch, jaws, lifted=True, away=(0.0, 0.0, 0.0)):
    """State with the needle at the meeting point, or `away` (m) from it.

    Args:
      taker: m, of its tip from its segment; the giver's is on its own.
      touch, jaws: of both; jaws that are not open are commanded to close.
      lifted: False for a needle that lies.
      away: m.
    """
    p = jnp.array(expert.MEET) + jnp.array(away) - AT[0] if lifted else START
    needle = Pose(jnp.eye(3), p)
    tips = p + jnp.asarray(AT) + jnp.array([[0.0, 0.0, expert.GRASP_ABOVE], taker])
    zeros = jnp.zeros(2)
    trocars = rcm.trocar_frame(
        rcm.Trocar(zeros, zeros, zeros), jnp.array([[-0.06, 0.0, 0.15], [0.06, 0.0, 0.15]])
    )
    jaws = jnp.array(jaws)
    target = jnp.where(jaws > 0.0, 1.0, -1.0)
    action = jnp.concatenate([jnp.zeros((2, 1)), tips], -1)
    pose, _ = rcm.ACTION_SPACES["rcm4"].decode(action, trocars)
    return types.SimpleNamespace(
        pose=Pose(pose.R, tips),
        measurements=types.SimpleNamespace(needle=needle, touch=jnp.array(touch)),
        layout=types.SimpleNamespace(needle=Pose(jnp.eye(3), START)),
        measured_trocar=trocars,
        gripper_target=target,
        gripper=jaws,
        touch=jnp.array(touch),
        velocity=jnp.zeros((2, 7)),
        step=jnp.asarray(50),
    )


GIVER, TAKER, BOTH = (True, False), (False, True), (True, True)
PARKED = (0.05, 0.0, 0.02)  # m, a tool that waits or has gone


@pytest.mark.parametrize(
    ("taker", "touch", "jaws", "away", "phase"),
    [
        (PARKED, GIVER, (FULL, OPEN), (-0.03, 0.0, 0.0), "carry"),
        (PARKED, GIVER, (FULL, OPEN), (0.0, 0.0, 0.0), "near"),
        ((0.004, -0.003, 0.012), GIVER, (FULL, OPEN), (0.0, 0.0, 0.0), "meet"),
        ((0.001, 0.0, 0.004), GIVER, (FULL, OPEN), (0.0, 0.0, 0.0), "meet"),
        ((0.004, 0.0, 0.002), GIVER, (FULL, OPEN), (0.0, 0.0, 0.0), "near"),  # next to it
        ((0.001, 0.0, 0.004), GIVER, (FULL, EMPTY), (0.0, 0.0, 0.0), "near"),  # closed too high
        ((0.0, 0.0, 0.001), BOTH, (FULL, FULL), (0.0, 0.0, 0.0), "open"),
        ((0.0, 0.0, 0.001), TAKER, (OPEN, FULL), (0.0, 0.0, 0.0), "away"),
    ],
)
def test_it_continues_from_the_tools_places(taker, touch, jaws, away, phase):
    state = state_of(taker, touch, jaws, away=away)
    for seed in range(4):
        script = rescue.RESCUER.resume(jax.random.key(seed), state)
        assert expert.PHASES[int(script.phase)] == phase
        command, _, _ = rescue.RESCUER.act(script, state)
        np.testing.assert_allclose(command.pose.p, state.pose.p, atol=0.5e-3)
        if phase == "meet" and np.linalg.norm(taker) < 0.01:
            assert int(script.held[1]) == SEGMENTS[1]


def test_a_giver_that_has_gone_stays_away():
    state = state_of((0.0, 0.0, 0.001), TAKER, (OPEN, FULL))
    state.pose = state.pose._replace(p=state.pose.p.at[0].add(jnp.array(expert.GO)))
    script = rescue.RESCUER.resume(jax.random.key(0), state)
    assert expert.PHASES[int(script.phase)] == "raise"
    np.testing.assert_array_equal(script.goal[0], state.pose.p[0])


@pytest.mark.parametrize(
    ("touch", "jaws", "lifted", "is_near"),
    [
        (GIVER, (FULL, EMPTY), True, True),
        (GIVER, (FULL, FULL), True, False),  # still closing
        (GIVER, (FULL, OPEN), True, False),
        (BOTH, (FULL, EMPTY), True, False),
        (GIVER, (FULL, EMPTY), False, False),
        ((False, False), (OPEN, EMPTY), True, False),  # dropped
    ],
)
def test_jaws_closed_on_nothing_announce_the_drop(touch, jaws, lifted, is_near):
    state = state_of((0.0, 0.0, 0.004), touch, jaws, lifted)
    assert bool(rescue.RESCUER.nearly_lost(state)) == is_near
