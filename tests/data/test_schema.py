"""Demonstrations of schema 1 (of the code at f5ed409, with the stub of its day) still load, and
today's seeds give the same episodes."""

import pathlib

import jax
import numpy as np
import pytest
import stubs

from starjax import rcm
from starjax.data import demos, load, schema, store
from starjax.rollouts import agent
from starjax.rollouts.placement import DeviceLayout
from starjax.sim import names

GOLDEN = pathlib.Path(__file__).parents[1] / "golden" / "demonstrations"
TROCARS = stubs.trocars(0, 8)


def quiet(root, **kwargs):
    return load.load(root, report=lambda _: None, **kwargs)


@pytest.mark.parametrize("observation", ["image", "state"])
def test_schema_1_is_loaded_as_one_arm_and_one_camera(observation):
    root = GOLDEN / f"schema_1_{observation}"
    assert store.read_description(root)["schema"] == 1
    found = quiet(root)
    seen, said, told = (found.dataset.observation, found.dataset.command, found.dataset.trocar)
    folders = sorted((root / "episodes").iterdir())

    def raw(name):
        return np.concatenate([np.load(folder / f"{name}.npy") for folder in folders])

    np.testing.assert_array_equal(seen.pose.p[:, 0], raw("p"))
    np.testing.assert_array_equal(seen.pose.R[:, 0], raw("R"))
    np.testing.assert_array_equal(seen.gripper[:, 0], raw("gripper"))
    np.testing.assert_array_equal(said.pose.p[:, 0], raw("command_p"))
    np.testing.assert_array_equal(said.gripper[:, 0], raw("command_gripper"))
    if observation == "image":
        np.testing.assert_array_equal(seen.images["camera"], raw("image"))
        np.testing.assert_array_equal(load.frames(root)["camera"].read(), raw("image"))
    else:
        np.testing.assert_array_equal(seen.state, raw("state"))
    np.testing.assert_array_equal(told.trocar.radius, TROCARS.radius)
    expected = rcm.trocar_position(TROCARS, stubs.P_WORLD_REF[:1])
    np.testing.assert_allclose(told.p_world_trocar, expected, atol=1e-7)
    np.testing.assert_array_equal(told.roll_zero, 0.0)


def test_schema_1_is_described_as_schema_2_is():
    before = store.read_description(GOLDEN / "schema_1_image")
    found = schema.upgraded(before)
    assert found["scene"] == names.FIRST._asdict() and found["expert"] == "one_wall"
    assert found["model"] == before["scene"] and "one_wall" not in found
    assert np.shape(found["trocars"]) == (2, 1, 3) and np.shape(found["p_world_ref"]) == (1, 3)
    assert found["features"]["p"]["shape"] == [1, 3]
    assert found["features"]["image_camera"]["shape"] == [6, 6, 3]
    assert schema.upgraded(found | {"schema": 2}) == found | {"schema": 2}


@pytest.mark.parametrize("observation", ["image", "state"])
def test_the_same_seed_gives_the_same_episodes(tmp_path, observation):
    settings = schema.DemoSettings(1, 0, 100, keep_failures=observation == "image")
    env, expert = stubs.make_env(observation, unlucky=0.4), agent.from_single(stubs.EXPERT)
    demos.collect(tmp_path, env, expert, TROCARS, settings, layout=DeviceLayout(lanes=5))
    ours, theirs = quiet(tmp_path), quiet(GOLDEN / f"schema_1_{observation}")
    jax.tree.map(np.testing.assert_array_equal, ours.dataset, theirs.dataset)
    for record in (store.verify(tmp_path, key) for key in store.keys(tmp_path)):
        before = store.verify(GOLDEN / f"schema_1_{observation}", record["key"])
        same = ("trocar", "trial", "seed", "length", "success", "invalid", "loose", "collided")
        assert {name: record[name] for name in same} == {name: before[name] for name in same}
        assert record["radius"] == [before["radius"]]
