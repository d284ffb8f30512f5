"""What an extra's page says that it is enough for, in a process with that extra alone."""

import pathlib
import re
import subprocess
import sys

import alone
import pytest

from starjax import cli
from starjax.core import extras

ROOT = pathlib.Path(__file__).parents[1]


def block(page):
    """The first program of a page."""
    return re.search(r"^```python\n(.*?)^```$", (ROOT / page).read_text(), re.DOTALL | re.M)[1]


def run(chosen, program):
    argv = [sys.executable, str(ROOT / "tests" / "alone.py"), chosen, program]
    return subprocess.run(argv, capture_output=True, text=True, timeout=300, cwd=ROOT)


PROGRAMS = {
    "serve": block("docs/use/deploy.md"),
    "gym": block("docs/use/reinforcement-learning.md"),
}


@pytest.mark.parametrize("extra", [name for name in PROGRAMS if name in extras.PACKAGES])
def test_the_first_program_of_its_page_runs(extra):
    done = run(extra, PROGRAMS[extra])
    assert done.returncode == 0, done.stderr


# The lines `pip install '.[...]'` of the pages.
INSTALLED = ["sim", "sim,serve", "sim,train,formats", "train,report", "train,viewer"]


@pytest.mark.parametrize("chosen", INSTALLED)
def test_commands_of_installed_extras_start(chosen):
    has = {package for extra in chosen.split(",") for package in packages(extra)}
    ours = [
        name
        for name, command in cli.COMMANDS.items()
        if {package for extra in command.extras for package in extras.PACKAGES[extra]} <= has
    ]
    helps = f"""
import contextlib, io, sys
from starjax import cli
for name in {ours}:
    with contextlib.redirect_stdout(io.StringIO()):
        code = cli.guard(cli.dispatch, [name, "--help"])
    module = cli.COMMANDS[name].path.split(":")[0]
    assert not code and __import__(module), name
"""
    assert len(ours) >= 3
    done = run(chosen, helps)
    assert done.returncode == 0, done.stderr


def packages(extra):
    """Packages of an extra and of those that it includes."""
    included = {"train": ["sim"], "report": ["sim", "video"], "viewer": ["train"], "gym": ["sim"]}
    return extras.PACKAGES[extra] + tuple(
        name for other in included.get(extra, []) for name in packages(other)
    )


def test_a_policy_is_loaded_without_a_simulator():
    """The quick sister of the above: a robot's computer has the extra `serve`."""
    program = """
import sys
from starjax.policies import packaged
from starjax import deploy
names = [deploy.load(name).scene.task for name in packaged.names()]
assert len(names) >= 5 and not {"mujoco", "tyro", "optax"} & set(sys.modules)
"""
    hidden = alone.brought(["starjax[serve]"])
    assert "mujoco" not in hidden and {"flax", "websockets", "jax"} <= hidden
    done = run("serve", program)
    assert done.returncode == 0, done.stderr
