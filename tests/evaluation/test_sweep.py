"""Trocars beyond the twelve, and success over the distance to training's."""

import collections
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import stubs
import synthetic

from starjax import rcm
from starjax.evaluation import evaluate, sweep
from starjax.sim import registries
from starjax.sim.rollouts import agent

TRAINING = stubs.trocars(*range(8))
P_REF = stubs.P_WORLD_REF[:1]


def test_samples_stay_in_their_ranges_and_repeat():
    task, two = (registries.tasks.get(name) for name in ("peg_transfer", "needle_handover"))
    drawn = sweep.sample(3, 500, task)
    assert (drawn.radius <= 0.05).all() and (np.abs(np.rad2deg(drawn.polar) - 90) <= 20).all()
    np.testing.assert_array_equal(drawn.radius, sweep.sample(3, 500, task).radius)
    assert drawn.radius.shape == (500, 1) and sweep.sample(3, 5, two).radius.shape == (5, 2)
    np.testing.assert_array_equal(  # unchanged since 0.1
        drawn.azimuth, rcm.sample_trocar(jax.random.key(3), (500, 1)).azimuth
    )
    with pytest.raises(ValueError, match="count"):
        sweep.sample(0, 0, task)


@pytest.mark.parametrize(("polars", "places"), [([70, 90, 110], 73), ([0, 90, 180], 29)])
def test_a_grid_has_every_place_once(polars, places):
    """The centre, and those straight above and below it, which every azimuth gives."""
    polars, azimuths = np.deg2rad(polars), np.deg2rad(np.arange(0, 360, 30))
    found = sweep.grid([0.0, 0.02, 0.05], polars, azimuths)
    there = np.asarray(rcm.trocar_position(found, P_REF))[:, 0]
    assert len(found.radius) == places == len(np.unique(there.round(6), axis=0))
    with pytest.raises(ValueError, match="radius"):
        sweep.grid([-0.01], polars, azimuths)


def test_distance_is_to_the_nearest_training_trocar():
    far = sweep.distance_to_nearest(stubs.trocars(*range(12)), TRAINING, P_REF)
    np.testing.assert_allclose(far[:8], 0, atol=1e-7)
    assert far[11] == pytest.approx(0.02, abs=1e-6)  # the centre, 2 cm from the inner four
    assert (far[8:] > 0.01).all()


def test_distance_of_a_configuration_is_that_of_its_farthest_arm():
    training = stubs.trocars(*range(8), arms=2)
    here = stubs.trocars(*range(8), arms=2)
    here.radius[3, 1] += 0.004
    far = sweep.distance_to_nearest(here, training, stubs.P_WORLD_REF)
    np.testing.assert_allclose(far, np.where(np.arange(8) == 3, 0.004, 0.0), atol=1e-7)


def test_seen_are_the_training_trocars_and_none_beside_them():
    radius, polar, azimuth = stubs.trocars(0, 1, 0)
    near = rcm.Trocar(radius + np.float32([[0], [0], [0.004]]), polar, azimuth)
    found = synthetic.outcomes(np.random.default_rng(0), near, np.arange(3), np.ones(3))
    result = sweep.compose(found, TRAINING, P_REF, seed=0)
    assert [trial["seen"] for trial in result["trials"]] == [True, True, False]


def test_a_sweep_of_a_policy(tmp_path):
    sample, params = stubs.make_policy(width=32)
    drawn = sweep.sample(0, 12, registries.tasks.get("peg_transfer"))
    found = evaluate.evaluate(
        tmp_path,
        stubs.make_env(),
        agent.from_policy(sample, 2, 4),
        (params, jnp.float32(1.0)),
        drawn,
        evaluate.EvaluationSettings(trials=1, seed=0, time_limit_s=1.0),
    )
    result = sweep.compose(found, TRAINING, P_REF, seed=0)
    assert sum(b["trials"] for b in result["by_distance"]) == 12 == result["strict"]["trials"]
    assert sum(b["successes"] for b in result["by_distance"]) == result["strict"]["successes"]
    far = sweep.distance_to_nearest(drawn, TRAINING, P_REF)
    np.testing.assert_allclose([t["distance_m"] for t in result["trials"]], far, atol=1e-6)
    for each in result["by_distance"]:
        inside = (far >= each["low_m"]) & (far < each["high_m"])
        assert inside.sum() == each["trials"]
    json.dumps(result, allow_nan=False)


def test_outcomes_of_a_sweep_are_their_own_and_its_bins_those_of_the_report():
    azimuths = 2 * np.pi * np.arange(12) / 12
    places = sweep.grid(np.arange(6) / 100, np.deg2rad([70, 90, 110]), azimuths)
    count = len(places.radius)
    rows = synthetic.outcomes(
        np.random.default_rng(0), places, np.arange(count), np.full(count, 0.5)
    )
    rows = rows._replace(safe=rows.success & (np.arange(count) % 2 == 0))
    found = sweep.compose(rows, TRAINING, P_REF, seed=0)
    for name, column in (("strict", rows.success), ("loose", rows.loose), ("safe", rows.safe)):
        assert found[name]["successes"] == column.sum()
    assert sum(b["successes"] for b in found["by_distance"]) == rows.success.sum()
    there = collections.Counter(int(sweep.bin_of(t["distance_m"])) for t in found["trials"])
    assert [b["trials"] for b in found["by_distance"]] == [there[b] for b in sorted(there)]
