"""When physics counts as diverged, and when the jaws touch the block."""

import types

import jax.numpy as jnp
import pytest

from starjax.sim import physics
from starjax.sim.tasks.peg_transfer import task
from starjax.types import Pose


@pytest.mark.parametrize(
    ("field", "body", "value", "sound"),
    [
        ("qvel", "arm_dof", 10.0, True),
        ("qvel", "arm_dof", -30.0, False),
        ("qvel", "block_dof", 3.0, True),
        ("qvel", "block_dof", -8.0, False),
        ("qpos", "block", 0.5, True),
        ("qpos", "block", -1.5, False),
        ("qacc_warmstart", "arm_dof", jnp.nan, False),
    ],
)
def test_speeds_and_places_beyond_anything_physical_are_unsound(sim, field, body, value, sound):
    block = Pose(jnp.eye(3), jnp.array([0.0, 0.0, task.RIM_HEIGHT]))
    state = physics.initial(sim, jnp.asarray(sim.home), block)
    changed = getattr(state, field).at[getattr(sim, body)].set(value)
    assert bool(physics.is_sound(sim, state.replace(**{field: changed}))) == sound


def test_jaws_touch_the_block_where_a_pad_overlaps_a_wall(sim):
    pad, wall, peg = sim.pad_geoms[0], sim.wall_geoms[0], sim.peg_geoms[0]

    def touches(distance, *pair):
        contact = types.SimpleNamespace(geom=jnp.array([pair]), dist=jnp.array([distance]))
        data = types.SimpleNamespace(_impl=types.SimpleNamespace(contact=contact))
        return bool(physics._jaw_contact(sim, data))

    assert touches(-1e-5, pad, wall) and touches(-1e-5, wall, pad)
    assert not touches(1e-5, pad, wall)
    assert not touches(-1e-5, pad, peg) and not touches(-1e-5, peg, wall)
