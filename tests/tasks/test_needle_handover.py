"""Needle hand-over: holders of the needle, slip, drops, and the trial's outcome."""

import jax
import jax.numpy as jnp
import pytest

from starjax.core.types import Pose
from starjax.sim import scene
from starjax.sim.task import Contacts, SimReadings
from starjax.tasks.needle_handover import task
from starjax.tasks.needle_pick import task as single

NO_CONTACTS = Contacts(jnp.zeros((0, 2), jnp.int32), jnp.zeros(0))
GIVER, BOTH, TAKER, NOBODY = (True, False), (True, True), (False, True), (False, False)


@pytest.fixture(scope="module")
def play():
    """`steps -> (measurements, TaskStatus)`; a step is (touch, height m, taker's tip aside m)."""
    m = scene.compose(scene.name("needle_handover"))
    bound = single.bind(m)
    layout = task.sample(bound, jax.random.key(0))

    @jax.jit
    def one(before, touch, height, aside):
        needle = layout.needle._replace(p=layout.needle.p.at[2].add(height))
        qpos = single.place_objects(bound, jnp.zeros(m.nq), layout.replace(needle=needle))
        tips = jnp.stack([needle.p, needle.p + jnp.stack([aside, 0 * aside, 0 * aside])])
        R, still = jnp.stack([jnp.eye(3)] * 2), jnp.zeros((2, 3))
        opening = jnp.zeros(2)
        readings = SimReadings(
            qpos, jnp.zeros(m.nv), Pose(R, tips), still, opening, touch, NO_CONTACTS
        )
        measurements = task.measure(bound, layout, readings, before)
        return measurements, task.status(bound, layout, measurements)

    def play(*steps):
        measurements, status = None, None
        for touch, height, *aside in steps:
            given = jnp.array(touch), jnp.array(height), jnp.array(aside[0] if aside else 0.0)
            measurements, status = one(measurements, *given)
        return measurements, status

    return play


def test_the_needle_goes_from_one_to_the_other(play):
    lifted, both = (GIVER, 0.03), (BOTH, 0.03)
    stages = [
        int(play(*steps)[1].stage)
        for steps in (
            [(NOBODY, 0.0)],
            [(GIVER, 0.0)],
            [lifted],
            [lifted, both],
            [lifted, both, (TAKER, 0.03)],
        )
    ]
    assert stages == [0, 1, 2, 2, 4]
    _, status = play(lifted, both, (TAKER, 0.03))
    assert status.success_now and status.loose and float(status.reward) == 1.0


def test_the_other_tool_alone_does_not_count(play):
    for steps in ([(TAKER, 0.03)], [(TAKER, 0.0), (TAKER, 0.03)], [(GIVER, 0.0), (TAKER, 0.03)]):
        _, status = play(*steps)
        assert not status.success_now and not status.loose


def test_slip_begins_a_hold_anew(play):
    start = [(GIVER, 0.03), (BOTH, 0.03), (TAKER, 0.03)]
    slipped = (TAKER, 0.03, 1.2 * single.SLIP)
    measurements, status = play(*start, slipped)
    assert not status.success_now and status.loose
    assert float(measurements.slip) > single.SLIP
    measurements, status = play(*start, slipped, slipped)
    assert status.success_now and float(measurements.slip) == 0.0
    assert play(*start, (TAKER, 0.03, 0.8 * single.SLIP))[1].success_now


def test_a_drop_is_a_failure(play):
    dropped = [(NOBODY, 0.0)] * (task.DROPPED_STEPS + 1)
    assert not play((GIVER, 0.0), *dropped)[1].lost  # never lifted
    assert not play((GIVER, 0.03), *dropped[1:])[1].lost
    assert play((GIVER, 0.03), *dropped)[1].lost
