"""Every example runs, programs as scripts and the notebook cell by cell."""

import json
import runpy

import matplotlib.pyplot as plt
import pytest

SHORT = {"11_ppo": ["--envs", "4", "--iterations", "2"]}
MARKS = {  # some compile, or start a server
    **{name: [pytest.mark.slow] for name in ("12_export",)},
    **{name: [pytest.mark.release] for name in ("04_closed_loop", "06_far_robot", "11_ppo")},
}
PEERS = {"14_serve_lerobot"}  # needs LeRobot: tests/addons/peers/lerobot_closed_loop.py runs it


def pytest_generate_tests(metafunc):
    if "file" not in metafunc.fixturenames:
        return
    examples = metafunc.config.rootpath.glob("examples/*.py")
    files = sorted(file for file in examples if file.stem not in PEERS)
    metafunc.parametrize(
        "file", [pytest.param(file, id=file.stem, marks=MARKS.get(file.stem, [])) for file in files]
    )


def test_example_runs(file, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.argv", [str(file), *SHORT.get(file.stem, [])])
    runpy.run_path(str(file), run_name="__main__")
    assert capsys.readouterr().out.strip()


@pytest.mark.slow
def test_notebook_runs(pytestconfig, tmp_path, monkeypatch):
    """In this process instead of a kernel, which would start jax and its programs anew."""
    monkeypatch.chdir(tmp_path)
    notebook = json.loads((pytestconfig.rootpath / "examples" / "quickstart.ipynb").read_text())
    names = {"__name__": "__main__"}
    for cell in notebook["cells"]:
        assert cell["cell_type"] == "markdown" or not cell["outputs"], "outputs are not kept"
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), cell["id"], "exec"), names)
    assert len(names["figure"].axes) == 3 and max(names["errors_mm"]) < 1
    assert bool(names["state"].success)
    plt.close("all")
