"""Trials in a file next to a result equal those in it."""

import json

import numpy as np
import pytest

from starjax.evaluation import trial_file
from starjax.runtime import files

UNLABELLED = {"radius": [0.04], "labels": {}, "success": True}
LABELLED = {
    "trocar": 0,
    "radius": [0.04, 0.02],
    "labels": {"source": 4, "target": 11},
    "success": False,
    "rcm_max_mm": 0.0813822,
}


@pytest.mark.parametrize("record", [LABELLED, UNLABELLED])
def test_records_come_back(tmp_path, record):
    changed = {k: not v if isinstance(v, bool) else v for k, v in record.items()}
    result = {"schema": 2, "trials": [record, changed]}
    files.write_json(tmp_path / "result.json", result)
    trial_file.detach(tmp_path / "result.json")
    kept = json.loads((tmp_path / "result.json").read_text())
    assert kept == {"schema": 2, "trials": "result.trials.npz"}
    found = trial_file.read(tmp_path / "result.json")
    for trial, wanted in zip(found["trials"], result["trials"], strict=True):
        assert trial.keys() == wanted.keys()
        for name, value in trial.items():
            if isinstance(value, dict):
                assert value == wanted[name]
            else:
                assert type(value) is type(wanted[name])
                np.testing.assert_allclose(value, wanted[name], rtol=1e-7)


def test_a_result_with_its_trials_in_it_is_read_as_it_is(tmp_path):
    for trials in ([LABELLED], [], None):
        files.write_json(tmp_path / "result.json", {"trials": trials})
        assert trial_file.read(tmp_path / "result.json") == {"trials": trials}


@pytest.mark.parametrize("name", ["gone.npz", "../result.trials.npz", "/result.trials.npz"])
def test_trials_that_are_not_beside_the_result_are_refused(tmp_path, name):
    (tmp_path / "a").mkdir()
    files.write_npz(tmp_path / "result.trials.npz", {"steps": np.arange(3)})
    files.write_json(tmp_path / "a" / "result.json", {"trials": name})
    with pytest.raises(ValueError, match=r"a/result\.json: trials"):
        trial_file.read(tmp_path / "a" / "result.json")


@pytest.mark.parametrize("records", [[{"a": 1}, {"b": 1}], [{"a": 1}, {"a": None}], [{"a": "x"}]])
def test_what_is_no_table_is_refused(records):
    with pytest.raises(ValueError, match="expected"):
        trial_file.columns(records)


def test_a_damaged_file_is_named(tmp_path):
    files.write_json(tmp_path / "result.json", {"trials": [LABELLED]})
    trial_file.detach(tmp_path / "result.json")
    beside = tmp_path / "result.trials.npz"
    beside.write_bytes(beside.read_bytes()[:-30])
    with pytest.raises(ValueError, match=r"result\.trials\.npz is damaged"):
        trial_file.read(tmp_path / "result.json")
