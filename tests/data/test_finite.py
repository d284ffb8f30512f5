"""Numbers of a task that are not finite are refused while they are collected, by their field."""

import numpy as np
import pytest
import stubs

from starjax.core import errors
from starjax.data import demos, schema
from starjax.sim.rollouts import agent


def test_a_state_that_is_not_finite_names_its_field(tmp_path):
    env = stubs.make_env("state")

    def observe(state):
        seen = env.observe(state)
        return seen._replace(state=seen.state.at[10].set(np.nan))

    settings = schema.DemoSettings(per_trocar=1, seed=0, max_steps=100)
    expert = agent.from_single(stubs.EXPERT)
    with pytest.raises(errors.UsageError) as caught:
        demos.collect(tmp_path, env._replace(observe=observe), expert, stubs.trocars(0), settings)
    assert caught.value.argument == "task reach: state" and "again.p of" in caught.value.got
