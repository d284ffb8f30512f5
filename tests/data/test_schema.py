"""Today's seeds give the golden episodes, and files of schema 1 are refused."""

import pathlib

import jax
import numpy as np
import pytest
import stubs

from starjax.data import demos, load, schema, store
from starjax.sim.rollouts import agent
from starjax.sim.rollouts.placement import DeviceLayout

GOLDEN = pathlib.Path(__file__).parents[1] / "golden" / "demonstrations"
TROCARS = stubs.trocars(0, 8)


def quiet(root, **kwargs):
    return load.load(root, report=lambda _: None, **kwargs)


def test_files_of_schema_1_are_refused(tmp_path):
    (tmp_path / "dataset.json").write_text('{"schema": 1}')
    with pytest.raises(ValueError, match="expected schema 2, got 1"):
        quiet(tmp_path)


@pytest.mark.parametrize("observation", ["image", "state"])
def test_the_same_seed_gives_the_same_episodes(tmp_path, observation):
    settings = schema.DemoSettings(1, 0, 100, keep_failures=observation == "image")
    env, expert = stubs.make_env(observation, unlucky=0.4), agent.from_single(stubs.EXPERT)
    demos.collect(tmp_path, env, expert, TROCARS, settings, layout=DeviceLayout(lanes=5))
    ours, theirs = quiet(tmp_path), quiet(GOLDEN / observation)
    jax.tree.map(np.testing.assert_array_equal, ours.dataset, theirs.dataset)
    for record in (store.verify(tmp_path, key) for key in store.keys(tmp_path)):
        before = store.verify(GOLDEN / observation, record["key"])
        same = ("trocar", "trial", "seed", "length", "success", "invalid", "loose", "collided")
        assert {name: record[name] for name in same} == {name: before[name] for name in same}
        assert record["radius"] == before["radius"]
