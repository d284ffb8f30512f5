"""Scripts' motions: short slopes, and phases of jaws that end as the jaws arrive."""

import types

import jax.numpy as jnp
import numpy as np
import pytest

from starjax.core import registry
from starjax.sim import registries
from starjax.sim.task import CONTROL_HZ
from starjax.tasks import scripting
from starjax.tasks.needle_handover import expert as handover
from starjax.tasks.peg_transfer import expert as peg
from starjax.tasks.peg_transfer_bimanual import expert as bimanual

SLOPE = scripting.SLOPE


def test_a_way_has_constant_speed_between_short_slopes():
    s = np.linspace(0.0, 1.0, 1001)
    done = np.asarray(scripting.sloped(jnp.asarray(s)))
    speed = np.gradient(done, s)
    np.testing.assert_allclose(done[[0, 500, -1]], [0.0, 0.5, 1.0], atol=1e-6)
    assert speed.min() > -1e-3 and max(speed[0], speed[-1]) < 0.01
    inner = (s > SLOPE + 0.01) & (s < 0.99 - SLOPE)
    np.testing.assert_allclose(speed[inner], 1.0 / (1.0 - SLOPE), rtol=1e-3)


def test_jaws_move_at_one_speed_and_are_waited_for_two_steps():
    before, target = jnp.array([1.0, 0.2, -1.0]), jnp.array([-1.0, -0.6, -1.0])
    times = np.arange(0, 11) / CONTROL_HZ
    moved = np.stack([scripting.jaws(before, target, time) for time in times])
    speed = np.abs(np.diff(moved, axis=0)).max(axis=0) * CONTROL_HZ
    np.testing.assert_allclose(speed[:2], 2.0 / scripting.JAW_TIME, rtol=1e-5)
    np.testing.assert_allclose(moved[-1], target, atol=1e-6)
    travel = 2.0 / (2.0 / scripting.JAW_TIME)
    assert float(scripting.jaw_limit(before, target)) == pytest.approx(travel + 2 / CONTROL_HZ)


@pytest.mark.parametrize(
    ("target", "sent", "touch", "measured", "arrived"),
    [
        ((-1, 1), (-1, 1), (True, False), (-0.5, 1.0), True),
        ((-1, 1), (-0.9, 1), (True, False), (-0.5, 1.0), False),  # still on their way
        ((-1, 1), (-1, 1), (False, False), (-0.9, 1.0), False),  # nothing between them
        ((-1, 1), (-1, 1), (True, False), (0.4, 1.0), False),  # one pad touches
        ((-1, 1), (-1, 1), (True, False), (-0.5, 0.5), False),  # not clear yet
        ((1, -1), (0.9, -1), (False, True), (0.85, -0.5), True),
    ],
)
def test_phases_of_jaws_end_by_what_is_measured(target, sent, touch, measured, arrived):
    state = types.SimpleNamespace(
        gripper_target=jnp.array(sent), touch=jnp.array(touch), gripper=jnp.array(measured)
    )
    assert bool(scripting.have_arrived(jnp.array(target), state)) == arrived


@pytest.mark.parametrize(
    ("names", "jaws"),
    [
        ({3, 7}, peg.TIMING.jaws),
        ({"close", "take", "open"}, (handover.PHASES, handover.PLAY.jaws)),
        ({"close", "take", "open", "release"}, (bimanual.PHASES, bimanual.PLAY.jaws)),
    ],
    ids=["peg_transfer", "needle_handover", "peg_transfer_bimanual"],
)
def test_jaws_move_alone(names, jaws):
    phases, ends = jaws if isinstance(jaws[0], tuple) else (range(len(jaws)), jaws)
    assert {
        p for p, moves in zip(phases, scripting.is_of_jaws(ends), strict=True) if moves
    } == names


@pytest.mark.parametrize("name", registries.tasks.names())
def test_no_phase_of_jaws_lasts_by_a_clock(name):
    for path in registries.tasks.get(name).experts.values():
        module = registry.load(str(path).partition(":")[0] + ":__dict__")
        table = module.get("TIMING") or module.get("PLAY")
        if table is not None:
            duration = np.asarray(table.duration)[scripting.is_of_jaws(table.jaws)]
            assert (duration == 0.0).all()
