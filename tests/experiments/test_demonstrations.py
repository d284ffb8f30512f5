"""Demonstrations of a run: which are asked for."""

import dataclasses

import mistakes
import numpy as np
import pytest
import stubs

from starjax import config
from starjax.experiments import demonstrations, presets

SMOKE = presets.PRESETS["smoke"]


def test_too_few_steps_for_the_expert_name_the_setting(tmp_path, monkeypatch):
    from starjax.data import demos
    from starjax.rollouts import chunks

    def collect(*_, **settings):
        raise chunks.ExpertFailed("got 0 of 10 at trocar 0")

    monkeypatch.setattr(demos, "collect", collect)
    few = dataclasses.replace(SMOKE.demos, max_steps=1)
    tried = dataclasses.replace(SMOKE, demos=few, out=str(tmp_path))
    _, missing = demonstrations.plan(tried, stubs.make_env())
    with mistakes.of("demos.max_steps", 1) as caught:
        missing()
    assert "0 of 10" in caught.value.hint


@pytest.mark.parametrize(("seen", "one_wall"), [(1, True), (8, False)])
def test_demonstrations_are_those_that_were_asked_for(tmp_path, monkeypatch, seen, one_wall):
    from starjax import rcm
    from starjax.data import demos
    from starjax.sim.tasks.peg_transfer import expert

    given = []
    found = {"episodes": 0, "trials": 0, "frames": 0}
    monkeypatch.setattr(
        demos, "collect", lambda *a, **settings: given.append((a, settings)) or found
    )
    asked = config.DemosConfig(per_trocar=3, seen_trocars=seen, max_steps=7, one_wall=one_wall)
    chosen = dataclasses.replace(SMOKE, demos=asked, seed=5, out=str(tmp_path))
    demonstrations.plan(chosen, stubs.make_env())[1]()
    (((_, _, script, trocars), settings),) = given
    np.testing.assert_array_equal(trocars, [field[:seen] for field in rcm.TROCARS])
    assert script.init is (expert.init_with_one_wall if one_wall else expert.init)
    wanted = {"per_trocar": 3, "seed": 5, "max_steps": 7, "one_wall": one_wall}
    assert {name: settings[name] for name in wanted} == wanted
