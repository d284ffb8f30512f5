"""Every example runs as it stands."""

import runpy

import pytest

SHORT = {"ppo": ["--envs", "4", "--iterations", "2"]}
SLOW = {"closed_loop", "far_robot", "ppo"}  # compile the simulation, a server


def pytest_generate_tests(metafunc):
    files = sorted(metafunc.config.rootpath.glob("examples/*.py"))
    marks = {name: [pytest.mark.slow] for name in SLOW}
    metafunc.parametrize(
        "file", [pytest.param(file, id=file.stem, marks=marks.get(file.stem, [])) for file in files]
    )


def test_example_runs(file, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", [str(file), *SHORT.get(file.stem, [])])
    runpy.run_path(str(file), run_name="__main__")
    assert capsys.readouterr().out.strip()
