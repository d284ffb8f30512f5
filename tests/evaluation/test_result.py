"""Results are read as one type; damage is named; their origin is written."""

import copy
import json
import pathlib

import fakes
import numpy as np
import pytest
import stubs
import synthetic

from starjax.core import errors
from starjax.evaluation import result, trial_file
from starjax.runtime import provenance
from starjax.sim import names
from starjax.sim.rollouts import trocars

SCENE = names.SceneNames("hand_over", ("fr5", "panda"), ("grasper", "grasper"), ("left", "right"))
RESULTS = sorted((pathlib.Path(__file__).parents[2] / "experiments").rglob("result.json"))


def rows(arms):
    index = np.repeat(np.arange(12), 2)
    places = trocars.select(stubs.trocars(*range(12), arms=arms), index)
    return synthetic.outcomes(np.random.default_rng(0), places, index, np.full(24, 0.7))


def content():
    """Returns the values of a file."""
    made = {**synthetic.figures("stardiff", rows(1)), **synthetic.about("stardiff")}
    return {"schema": 2, "scene": fakes.SCENE._asdict(), **made}


def written(tmp_path, value):
    file = tmp_path / "result.json"
    file.write_text(json.dumps(value))
    return file


def test_every_result_of_the_repository_is_read():
    assert RESULTS
    for file in RESULTS:
        found, raw = result.read(file), json.loads(file.read_bytes())
        assert len(found.trials) == found.figures["strict"]["all"]["trials"] > 0
        won = sum(trial.success for trial in found.trials)
        assert won == raw["strict"]["all"]["successes"]


@pytest.fixture
def made(tmp_path):
    about = synthetic.about("stardiff") | {"control_hz": 25.0, "dataset_digest": "b" * 64}
    file, figures = tmp_path / "result.json", synthetic.figures("stardiff", rows(2))
    return file, result.write(file, SCENE, figures, about)


def test_what_is_written_is_read_again(made):
    file, written = made
    found = result.read(file)
    assert found == written and found.schema == 2 and found.scene == SCENE
    assert (found.version, found.commit, found.dirty) == provenance.code()
    assert found.dataset_digest == "b" * 64 and found.control_hz == 25.0 and found.seed == 0
    assert found.about["command"] == synthetic.about("stardiff")["command"]
    assert [len(trial.radius) for trial in found.trials] == [2] * 24
    assert {trial.stage for trial in found.trials} == {1, 3}


def test_settings_of_jax_that_are_not_the_usual_ones_are_written(made, monkeypatch):
    file, written = made
    assert "jax_settings" not in written.about
    monkeypatch.setenv("NVIDIA_TF32_OVERRIDE", "0")
    about = {**synthetic.about("stardiff"), "control_hz": 25.0}
    result.write(file, SCENE, synthetic.figures("stardiff", rows(2)), about)
    assert result.read(file).about["jax_settings"] == {"NVIDIA_TF32_OVERRIDE": "0"}


def test_trials_in_a_file_beside_it_are_found(made):
    file, before = made
    trial_file.detach(file)
    after = result.read(file)
    assert after._replace(trials=()) == before._replace(trials=())
    for ours, theirs in zip(after.trials, before.trials, strict=True):
        assert ours.labels == theirs.labels and ours.steps == theirs.steps
        np.testing.assert_allclose(ours.radius, theirs.radius, rtol=1e-6)


@pytest.mark.parametrize(
    ("place", "value", "argument"),
    [
        (("trials", 3, "polar"), "x", "trials[3].polar"),
        (("trials", 0, "success"), 1, "trials[0].success"),
        (("per_trocar", 0, "seen"), None, "per_trocar[0].seen"),
        (("config", "policy", "ddim_steps"), 0.5, "config.policy.ddim_steps"),
        (("strict", "all", "successes"), "x", "strict.all.successes"),
        (("method",), None, "method"),
    ],
)
def test_what_is_not_as_expected_is_named(tmp_path, place, value, argument):
    raw = at = copy.deepcopy(content())
    for name in place[:-1]:
        at = at[name]
    at[place[-1]] = value
    file = written(tmp_path, raw)
    with pytest.raises(errors.UsageError) as raised:
        result.read(file)
    assert raised.value.argument == f"{file}: {argument}"


def test_a_later_schema_and_a_damaged_file_are_named(tmp_path):
    file = written(tmp_path, content() | {"schema": 9})
    with pytest.raises(ValueError, match="expected schema 2, got 9"):
        result.read(file)
    file.write_bytes(b"{")
    with pytest.raises(ValueError, match=r"result\.json is damaged"):
        result.read(file)
    with pytest.raises(FileNotFoundError):
        result.read(tmp_path / "nothing.json")


def test_a_sweep_says_its_distances(tmp_path):
    synthetic.run(tmp_path, sweep_of=20)
    found = result.read_sweep(tmp_path / "sweep.json")
    assert len(found.trials) == 20 and all(t.distance_m is not None for t in found.trials)
    assert found.time_limit_s == 60.0 and found.config == {}
