"""`starjax sweep`: which trocars, whose trials, and flags that would do nothing."""

import dataclasses

import mistakes
import numpy as np
import pytest

from starjax.cli import bench, policy_args, sweep
from starjax.sim import registries


@pytest.mark.parametrize(
    ("typed", "argument", "got"),
    [
        ("--radii-cm 2 3 --azimuths 600000", "azimuths", 1200000),
        ("--azimuths 6", "azimuths", 6),
        ("--polars-deg 80", "polars_deg", 80),
        ("--radii-cm 2 --trocars 9", "trocars", 9),
        ("--radii-cm 2 -1", "radii_cm", -1),
        ("", "no/stardiff", "no config.json"),
    ],
)
def test_a_mistake_names_its_flag(typed, argument, got, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with mistakes.of(str(tmp_path / argument) if "/" in argument else argument, got):
        sweep.main(["no/stardiff", *typed.split()])


@pytest.mark.parametrize("command", [sweep, bench])
def test_a_renamed_folder_is_explained(command, tmp_path):
    with mistakes.of("RUN", tmp_path):
        command.main([str(tmp_path / "policy2")])


def test_a_grid_is_in_centimetres_and_degrees():
    grid = {"radii_cm": (2.0, 5.0), "polars_deg": (70.0,), "azimuths": 4}
    one, two = (registries.tasks.get(name) for name in ("peg_transfer", "needle_handover"))
    found = sweep._trocars(sweep.SweepArgs(**grid), one)
    np.testing.assert_allclose(np.unique(found.radius), [0.02, 0.05], rtol=1e-6)
    np.testing.assert_allclose(np.rad2deg(found.polar), 70, rtol=1e-6)
    np.testing.assert_allclose(np.rad2deg(found.azimuth[:4, 0]), [0, 90, 180, 270], atol=1e-4)
    with mistakes.of("radii_cm", (2.0, 5.0)):  # both arms in one place
        sweep._trocars(sweep.SweepArgs(**grid), two)


def test_sweeps_of_other_trials_lie_apart(tmp_path):
    one = sweep.SweepArgs()
    other = dataclasses.replace(one, eval=dataclasses.replace(one.eval, trials=2))
    same = dataclasses.replace(one, eval=dataclasses.replace(one.eval, chunk=2))
    assert sweep._trials(tmp_path, one) == sweep._trials(tmp_path, same)
    assert sweep._trials(tmp_path, one) != sweep._trials(tmp_path, other)


def test_sweeps_of_other_arms_and_of_files_lie_apart(tmp_path):
    file = tmp_path / "mine.safetensors"
    file.write_bytes(b"m")
    folders = [
        sweep._folder(policy_args.PolicyPath(file, run, arms))
        for run in (None, tmp_path / "stardiff")
        for arms in ((), ("ur5e",), ("ur5e", "panda"))
    ]
    assert len(set(folders)) == 6 and folders[3] == tmp_path / "stardiff"
