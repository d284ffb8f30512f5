"""Trocars beyond the twelve, and success over the distance to training's."""

import collections
import json

import jax.numpy as jnp
import numpy as np
import pytest
import stubs
import synthetic

from starjax import rcm
from starjax.evaluation import evaluate, sweep
from starjax.report import tables

TRAINING = rcm.Trocar(*(field[:8] for field in rcm.TROCARS))


def test_samples_stay_in_their_ranges_and_repeat():
    drawn = sweep.sample(3, 500)
    assert (drawn.radius <= 0.05).all() and (np.abs(np.rad2deg(drawn.polar) - 90) <= 20).all()
    np.testing.assert_array_equal(drawn.radius, sweep.sample(3, 500).radius)
    with pytest.raises(ValueError, match="count"):
        sweep.sample(0, 0)


@pytest.mark.parametrize(("polars", "places"), [([70, 90, 110], 73), ([0, 90, 180], 29)])
def test_a_grid_has_every_place_once(polars, places):
    """The centre, and those straight above and below it, which every azimuth gives."""
    polars, azimuths = np.deg2rad(polars), np.deg2rad(np.arange(0, 360, 30))
    found = sweep.grid([0.0, 0.02, 0.05], polars, azimuths)
    ports = np.asarray(rcm.trocar_position(found, stubs.P_WORLD_REF))
    assert len(found.radius) == places == len(np.unique(ports.round(6), axis=0))
    with pytest.raises(ValueError, match="radius"):
        sweep.grid([-0.01], polars, azimuths)


def test_distance_is_to_the_nearest_training_trocar():
    far = sweep.distance_to_nearest(rcm.TROCARS, TRAINING, stubs.P_WORLD_REF)
    np.testing.assert_allclose(far[:8], 0, atol=1e-7)
    assert far[11] == pytest.approx(0.02, abs=1e-6)  # the centre, 2 cm from the inner four
    assert (far[8:] > 0.01).all()


def test_seen_are_the_training_trocars_and_none_beside_them():
    radius, polar, azimuth = (field[[0, 1, 0]] for field in rcm.TROCARS)
    near = rcm.Trocar(radius + np.float32([0, 0, 0.004]), polar, azimuth)
    found = synthetic.outcomes(np.random.default_rng(0), near, np.arange(3), np.ones(3))
    result = sweep.compose(found, TRAINING, stubs.P_WORLD_REF, seed=0)
    assert [trial["seen"] for trial in result["trials"]] == [True, True, False]


def test_a_sweep_of_a_policy(tmp_path):
    policy, params = stubs.make_policy(width=32)
    trocars = sweep.sample(0, 12)
    found = evaluate.evaluate(
        tmp_path,
        stubs.make_env(),
        policy,
        params,
        jnp.float32(1.0),
        trocars,
        trials=1,
        seed=0,
        obs_horizon=2,
        execute=4,
        time_limit_s=1.0,
    )
    result = sweep.compose(found, TRAINING, stubs.P_WORLD_REF, seed=0)
    assert sum(b["trials"] for b in result["by_distance"]) == 12 == result["strict"]["trials"]
    assert sum(b["successes"] for b in result["by_distance"]) == result["strict"]["successes"]
    far = sweep.distance_to_nearest(trocars, TRAINING, stubs.P_WORLD_REF)
    np.testing.assert_allclose([t["distance_m"] for t in result["trials"]], far, atol=1e-6)
    for each in result["by_distance"]:
        inside = (far >= each["low_m"]) & (far < each["high_m"])
        assert inside.sum() == each["trials"]
    json.dumps(result, allow_nan=False)


def test_outcomes_of_a_sweep_are_their_own_and_its_bins_those_of_the_report():
    azimuths = 2 * np.pi * np.arange(12) / 12
    ports = sweep.grid(np.arange(6) / 100, np.deg2rad([70, 90, 110]), azimuths)
    count = len(ports.radius)
    rows = synthetic.outcomes(
        np.random.default_rng(0), ports, np.arange(count), np.full(count, 0.5)
    )
    rows = rows._replace(safe=rows.success & (np.arange(count) % 2 == 0))
    found = sweep.compose(rows, TRAINING, stubs.P_WORLD_REF, seed=0)
    for name, column in (("strict", rows.success), ("loose", rows.loose), ("safe", rows.safe)):
        assert found[name]["successes"] == column.sum()
    assert sum(b["successes"] for b in found["by_distance"]) == rows.success.sum()
    there = collections.Counter(tables._bin(trial) for trial in found["trials"])
    assert [b["trials"] for b in found["by_distance"]] == [there[b] for b in sorted(there)]
