"""The README prints the lines that make runs, and a second make installs nothing."""

import os
import re
import shutil
import subprocess

import pytest

pytestmark = pytest.mark.skipif(shutil.which("make") is None, reason="make is not installed")
TARGETS = {"run": "main", "test": "tests"}  # target -> block of the README


def make(folder, *args):
    """Returns the lines that make would run."""
    command = ["make", "-n", "--no-print-directory", *args]
    alone = {name: value for name, value in os.environ.items() if not name.startswith("MAKE")}
    done = subprocess.run(
        command, cwd=folder, env=alone, capture_output=True, text=True, check=True
    )
    return done.stdout.splitlines()


@pytest.fixture
def folder(pytestconfig, tmp_path):
    """A fresh clone: the files that make reads."""
    for name in ("Makefile", "pyproject.toml", "constraints.txt"):
        shutil.copy(pytestconfig.rootpath / name, tmp_path)
    (tmp_path / "weights").mkdir()
    shutil.copy(pytestconfig.rootpath / "weights" / "pyproject.toml", tmp_path / "weights")
    return tmp_path


@pytest.mark.parametrize(("target", "block"), TARGETS.items())
def test_readme_prints_the_lines_of_make(folder, pytestconfig, target, block):
    readme = (pytestconfig.rootpath / "README.md").read_text()
    match = re.search(rf"<!-- {block} -->\n```bash\n(.*?)^```$", readme, re.DOTALL | re.MULTILINE)
    assert match
    lines = [line for line in make(folder, "CUDA=", target) if not line.startswith("touch ")]
    assert lines == match[1].splitlines()


def test_readme_names_the_last_line_of_make_see(folder, pytestconfig):
    readme = (pytestconfig.rootpath / "README.md").read_text()
    assert f"`{make(folder, 'CUDA=', 'see')[-1]}`" in readme


def test_set_up_is_done_once_and_again_when_dependencies_change(folder):
    stamp = folder / ".venv" / "dev.stamp"
    (folder / ".venv" / "bin").mkdir(parents=True)
    for file in (folder / ".venv" / "bin" / "python", stamp):
        file.touch()
    assert make(folder, "test") == [".venv/bin/pytest -n 2 --dist loadfile"]
    newer = stamp.stat().st_mtime_ns + 10**9
    os.utime(folder / "constraints.txt", ns=(newer, newer))
    assert any("pip install" in line for line in make(folder, "test"))
