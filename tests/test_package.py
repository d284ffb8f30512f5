"""Promises of the package as a whole: no pickle, no hosts, no machine's paths, a quick --help."""

import ast
import os
import pathlib
import re
import subprocess
import sys

import pytest

import starjax
from starjax import cli

ROOT = pathlib.Path(__file__).parents[1]
PYTHON = sorted((ROOT / "src").rglob("*.py"))
TEXT = [
    path
    for folder in ("src", "tests", "mjcf", "benchmarks", "experiments", "docs", "examples")
    for path in (ROOT / folder).rglob("*")
    if path.suffix in {".py", ".md", ".xml", ".txt", ".toml", ".json", ".css", ".ipynb"}
]
TEXT += [
    path
    for path in ROOT.iterdir()
    if path.suffix in {".md", ".toml", ".yaml", ".yml", ".txt", ".cff"}
]
TEXT += [ROOT / ".ci" / "run", ROOT / "Makefile"]
# This machine, and whose documents a page may link to: package registries, hubs and trackers are
# none of them.
HOSTS = {
    "127.0.0.1",
    "arxiv.org",
    "doi.org",
    "colab.research.google.com",
    "docs.jax.dev",
    "docs.python.org",
    "flax.readthedocs.io",
    "github.com",
    "gymnasium.farama.org",
    "localhost",
    "mujoco.readthedocs.io",
    "pandas.pydata.org",
    "slurm.schedmd.com",
    "www.apache.org",
    "www.w3.org",
}
PICKLES = {"pickle.load", "pickle.loads", "pickle.dump", "pickle.dumps"}
HEAVY = ("jax", "mujoco", "flax", "scipy", "matplotlib")


def tree(path: pathlib.Path) -> ast.Module:
    return ast.parse(path.read_text())


def python(*args: str, **kwargs) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, *args], capture_output=True, text=True, **kwargs)


def test_no_pickle():
    """Neither the module, nor numpy's use of it; a restricted unpickler says so by its name."""
    for path, node in [(file, node) for file in PYTHON for node in ast.walk(tree(file))]:
        if isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            assert called not in {*PICKLES, "torch.load", "eval", "exec"}, path
            if called in {"np.load", "numpy.load"}:
                settings = {word.arg: ast.unparse(word.value) for word in node.keywords}
                assert settings.get("allow_pickle") == "False", f"{path}:{node.lineno}"


def test_no_hosts_and_no_paths_of_one_machine():
    for path in TEXT:
        text = path.read_text()
        found = {host.lower() for host in re.findall(r"https?://([\w.-]+)", text)} - HOSTS
        hosts = {host for host in found if not host.endswith("example.org")}
        paths = re.findall(r"(?<![\w./-])/(?:home|root|tmp|work|Users)/\w+", text)
        assert not hosts and not paths, path


@pytest.mark.parametrize("command", [[], *([name] for name in cli.COMMANDS)], ids=str)
def test_help_is_quick_and_imports_nothing_heavy(command):
    program = (
        "import sys\n"
        "from starjax import cli\n"
        f"sys.argv = ['starjax', *{command}, '--help']\n"
        "try:\n"
        "    cli.main()\n"
        "finally:\n"
        f"    print('HEAVY', sorted(set({HEAVY}) & set(sys.modules)))\n"
    )
    before = os.times()
    done = python("-c", program)
    after = os.times()
    assert done.returncode == 0, done.stderr
    assert "HEAVY []" in done.stdout
    # The processor's time, which on an idle machine is the user's, and on a busy one still exact.
    busy = after.children_user + after.children_system
    assert busy - before.children_user - before.children_system < 1.0


def test_every_folder_of_the_package_is_one():
    folders = {path.parent for path in PYTHON}
    assert all((folder / "__init__.py").exists() for folder in folders)


def test_import_of_the_package_is_light():
    assert python("-X", "importtime", "-c", "import starjax").stderr.count(" jax.") == 0


def test_the_citation_names_this_version():
    text = (ROOT / "CITATION.cff").read_text()
    assert re.search(r"^version: (.*)$", text, re.MULTILINE)[1] == starjax.__version__
    assert f"## {starjax.__version__}\n" in (ROOT / "CHANGELOG.md").read_text()


def test_module_entry_prints_help():
    done = python("-m", "starjax.experiments.run", "--help")
    assert done.returncode == 0 and "--policy.observation" in done.stdout
