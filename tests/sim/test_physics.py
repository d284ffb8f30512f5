"""When physics counts as diverged, and when the jaws touch the block."""

import jax
import jax.numpy as jnp
import pytest

from starjax.sim import physics
from starjax.sim.task import Contacts
from starjax.tasks.peg_transfer import task


@pytest.mark.parametrize(
    ("field", "body", "value", "sound"),
    [
        ("qvel", "arm", 10.0, True),
        ("qvel", "arm", -30.0, False),
        ("qvel", "block_dof", 3.0, True),
        ("qvel", "block_dof", -8.0, False),
        ("qpos", "block", 0.5, True),
        ("qpos", "block", -1.5, False),
        ("qacc_warmstart", "arm", jnp.nan, False),
    ],
)
def test_speeds_and_places_beyond_anything_physical_are_unsound(sim, field, body, value, sound):
    layout = task.sample(sim.bound, jax.random.key(0))
    state = physics.initial(sim, [jnp.asarray(sim.arms[0].home)], layout)
    at = {"arm": sim.arms[0].dof[0], "block_dof": sim.bound.block_dof, "block": sim.bound.block}
    changed = getattr(state, field).at[at[body]].set(value)
    assert bool(physics.is_sound(sim, state.replace(**{field: changed}))) == sound


def test_jaws_touch_the_block_where_a_pad_overlaps_a_wall(sim):
    pad, wall, peg = sim.arms[0].pads[0], sim.graspable[0], sim.bound.peg_geoms[0]

    def touches(distance, *pair):
        found = physics.touching(sim, Contacts(jnp.array([pair]), jnp.array([distance])))
        assert found.shape == (1,)
        return bool(found[0])

    assert touches(-1e-5, pad, wall) and touches(-1e-5, wall, pad)
    assert not touches(1e-5, pad, wall)
    assert not touches(-1e-5, pad, peg) and not touches(-1e-5, peg, wall)
