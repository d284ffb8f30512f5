"""The rescuer of bimanual peg transfer continues from the tools' places, and sees a miss."""

import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from starjax import rcm
from starjax.addons.finetune.rescuers import peg_transfer_bimanual as rescue
from starjax.core.types import Pose
from starjax.tasks.peg_transfer import task as single
from starjax.tasks.peg_transfer_bimanual import expert
from starjax.tasks.peg_transfer_bimanual.task import PARK

OPEN, EMPTY, FULL = 1.0, -1.0, -0.3  # measured openings
GIVER, TAKER, BOTH, NONE = (True, False), (False, True), (True, True), (False, False)
UP, LYING = expert.PLACE, (-0.03, 0.01, single.RIM_HEIGHT)  # m, of the block
PARKED = None


def state_of(block, giver, taker, touch, jaws):
    """Returns a state whose tips are so far (m) from their grasps, or at their parking places.

    Jaws that are not open are commanded to close.
    """
    zeros, jaws = jnp.zeros(2), jnp.array(jaws)
    trocars = rcm.trocar_frame(
        rcm.Trocar(zeros, zeros, zeros), jnp.array([[-0.06, 0.0, 0.15], [0.06, 0.0, 0.15]])
    )
    state = types.SimpleNamespace(
        pose=Pose(jnp.tile(jnp.eye(3), (2, 1, 1)), jnp.array(PARK)),
        measurements=types.SimpleNamespace(
            block=Pose(jnp.eye(3), jnp.array(block)), touch=jnp.array(touch)
        ),
        layout=types.SimpleNamespace(target_peg=jnp.array([0.03, 0.0])),
        measured_trocar=trocars,
        gripper_target=jnp.where(jaws > 0.0, 1.0, -1.0),
        gripper=jaws,
        touch=jnp.array(touch),
        velocity=jnp.zeros((2, 7)),
        step=jnp.asarray(50),
    )
    goals, _ = expert.PLAY.goals(expert.AGENT.init(jax.random.key(0), state), state)
    grasps = goals[expert.PHASES.index("down"), 0], goals[expert.PHASES.index("meet"), 1]
    for arm, off in enumerate((giver, taker)):
        if off is not PARKED:
            p = state.pose.p.at[arm].set(grasps[arm] + jnp.array(off))
            state.pose = state.pose._replace(p=p)
    return state


@pytest.mark.parametrize(
    ("block", "giver", "taker", "touch", "jaws", "phase"),
    [
        (LYING, (0.002, 0.0, 0.012), PARKED, NONE, (OPEN, OPEN), "down"),
        (LYING, (0.0, 0.0, 0.0002), PARKED, NONE, (OPEN, OPEN), "close"),
        (LYING, (0.012, 0.0, 0.002), PARKED, NONE, (OPEN, OPEN), "lift"),
        (LYING, (0.0, 0.0, 0.06), PARKED, NONE, (OPEN, OPEN), "above"),
        (UP, (0.0, 0.0, 0.0), PARKED, GIVER, (FULL, OPEN), "near"),
        ((-0.02, 0.0, 0.045), (0.0, 0.0, 0.0), PARKED, GIVER, (FULL, OPEN), "carry"),
        (UP, (0.0, 0.0, 0.0), (0.002, 0.0, 0.012), GIVER, (FULL, OPEN), "meet"),
        (UP, (0.0, 0.0, 0.0), (0.0155, 0.0, 0.0205), GIVER, (FULL, OPEN), "near"),  # just parked
        (UP, (0.0, 0.0, 0.0), (0.002, 0.0, 0.006), GIVER, (FULL, EMPTY), "near"),  # missed
        (UP, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), BOTH, (FULL, FULL), "open"),
        (UP, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), TAKER, (OPEN, FULL), "away"),
        (UP, (-0.02, 0.0, 0.02), (0.0, 0.0, 0.0), TAKER, (OPEN, FULL), "over"),
    ],
)
def test_it_continues_from_the_tools_places(block, giver, taker, touch, jaws, phase):
    state = state_of(block, giver, taker, touch, jaws)
    script = rescue.RESCUER.resume(jax.random.key(1), state)
    assert expert.PHASES[int(script.phase)] == phase
    _, _, label = rescue.RESCUER.act(script, state)
    np.testing.assert_allclose(label.pose.p, state.pose.p, atol=0.5e-3)


@pytest.mark.parametrize(
    ("block", "touch", "jaws", "is_near"),
    [
        (UP, GIVER, (FULL, EMPTY), True),
        (UP, GIVER, (FULL, FULL), False),  # still closing
        (UP, BOTH, (FULL, EMPTY), False),
        (LYING, GIVER, (FULL, EMPTY), False),
    ],
)
def test_jaws_closed_on_nothing_announce_the_drop(block, touch, jaws, is_near):
    state = state_of(block, (0.0, 0.0, 0.0), (0.0, 0.0, 0.006), touch, jaws)
    assert bool(rescue.RESCUER.nearly_lost(state)) == is_near
