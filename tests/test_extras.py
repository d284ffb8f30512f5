"""Functions without any extra, and messages of commands whose extra is missing."""

import importlib.metadata
import json
import pathlib
import re
import subprocess
import sys
import tomllib
import types

import pytest

from starjax import cli
from starjax.core import errors, extras

ROOT = pathlib.Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
# A process with only jax, numpy and their dependencies.
BARE = "import sys\nsys.modules |= dict.fromkeys({absent})\n"


def bare(program: str) -> subprocess.CompletedProcess:
    absent = {name for names in extras.PACKAGES.values() for name in names} - {"scipy"}  # jax's
    code = BARE.format(absent=sorted(absent)) + program
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)


def test_rcm_needs_no_extra():
    modules = "from starjax import rcm\nfrom starjax.core import types\n"
    done = bare(f"{modules}print(rcm.TROCARS.radius.shape)")
    assert done.stdout == "(12,)\n", done.stderr


@pytest.mark.parametrize("extra", extras.PACKAGES)
def test_extras_bring_what_their_names_say(extra):
    """The requirements of pyproject.toml, by the names that Python imports them by."""
    imported = importlib.metadata.packages_distributions()
    wanted = [re.split(r"[<>=;\[]", text)[0] for text in PROJECT["optional-dependencies"][extra]]
    brought = {
        name
        for name, dists in imported.items()
        if set(wanted) & {dist.lower().replace("_", "-") for dist in dists}
    }
    missing = set(extras.PACKAGES[extra]) - brought
    assert {name for name in missing if name in imported} == set()
    assert len(extras.PACKAGES[extra]) == len(set(wanted) - {"starjax", "mujoco-mjx"})


def test_all_has_every_extra_but_trackers():
    (everything,) = PROJECT["optional-dependencies"]["all"]
    names = everything.removeprefix("starjax[").removesuffix("]")
    assert set(names.split(",")) == set(extras.PACKAGES) - {
        "ros2",
        "tensorboard",
        "wandb",
    }  # one's choice


@pytest.mark.parametrize("command", cli.COMMANDS)
def test_a_command_without_its_extra_names_it(monkeypatch, command, capsys):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(errors.UsageError) as raised:
        cli.dispatch([command, "--help"])
    assert raised.value.argument == command and "[sim" in raised.value.hint
    assert cli.guard(cli.dispatch, [command]) == 2 and capsys.readouterr().err.count("\n") == 1


def test_an_evaluation_without_video_needs_no_report(monkeypatch):
    for name in (*extras.PACKAGES["report"], *extras.PACKAGES["video"]):
        if name != "scipy":  # jax's and the training's
            monkeypatch.setitem(sys.modules, name, None)
    for flag, argument in (("--no-video", "--policy"), ("--video", "evaluate --video")):
        with pytest.raises(errors.UsageError) as raised:
            cli.dispatch(["evaluate", "--policy", "no-such-policy", flag])
        assert raised.value.argument == argument


def test_an_installation_without_extras_lists_the_commands():
    done = bare("from starjax import cli; cli.dispatch(['--help'])")
    assert done.returncode == 0 and "evaluate" in done.stdout


def test_the_main_command_without_its_extra_is_one_line():
    program = "import runpy, sys\nsys.argv = ['run']\n"
    done = bare(program + "runpy.run_module('starjax.experiments.run', run_name='__main__')")
    assert done.returncode == 2 and done.stderr.count("\n") == 1
    assert "[sim,train,report]" in done.stderr


def test_an_extra_is_added_from_where_the_installation_came(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert extras.install("sim") == f"pip install -e '{ROOT}[sim]'"
    monkeypatch.chdir(ROOT)
    assert extras.install("sim,hub") == "pip install -e '.[sim,hub]'"
    wheel = tmp_path / "lib/starjax/extras.py"
    monkeypatch.setattr(extras, "__file__", str(wheel))
    git = {"url": "https://localhost/s", "vcs_info": {"vcs": "git", "commit_id": "0a1b"}}
    for record, named in (
        (json.dumps(git), "starjax[sim] @ git+https://localhost/s@0a1b"),
        (json.dumps({"url": "file:///x/s.whl"}), "starjax[sim] @ file:///x/s.whl"),
        (None, "starjax[sim]"),
    ):
        distribution = types.SimpleNamespace(read_text=lambda name, text=record: text)
        monkeypatch.setattr(importlib.metadata, "distribution", lambda name, d=distribution: d)
        assert extras.install("sim") == f"pip install '{named}'"
