"""Scripts outside the package name modules and objects that exist."""

import ast
import importlib
import pathlib
import types

import pytest

ROOT = pathlib.Path(__file__).parents[1]
FOLDERS = ("benchmarks", "docs", "examples", "experiments")
SCRIPTS = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))


def named(tree: ast.Module) -> dict[str, str]:
    """Returns local name -> the module or object of starjax that a script imports under it."""
    return {
        alias.asname or alias.name: f"{node.module}.{alias.name}"
        for node in ast.walk(tree)
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "starjax"
        for alias in node.names
    }


def absent(text: str) -> set[str]:
    """Returns the names of starjax that a script reads and that do not exist."""
    tree = ast.parse(text)
    places = named(tree)
    found = {name: _load(place) for name, place in places.items()}
    nodes = [*ast.walk(tree)]
    stored = {n.id for n in nodes if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
    stored |= {node.arg for node in nodes if isinstance(node, ast.arg)}
    wrong = {places[name] for name, value in found.items() if value is None}
    for node in nodes:
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            module = found.get(node.value.id)
            is_module = isinstance(module, types.ModuleType) and node.value.id not in stored
            if is_module and not hasattr(module, node.attr):
                wrong.add(f"{module.__name__}.{node.attr}")
    return wrong


def _load(place: str) -> object:
    """Returns a module or an object of one, None if it does not exist."""
    module, _, name = place.rpartition(".")
    parent = importlib.import_module(module)
    if not hasattr(parent, name):
        try:
            return importlib.import_module(place)
        except ModuleNotFoundError:
            return None
    return getattr(parent, name)


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_name_of_starjax_exists(script):
    assert absent(script.read_text()) == set()


def test_an_absent_name_is_found():
    text = "from starjax.runtime import xla\nfrom starjax import polcy\nxla.requires()\n"
    assert absent(text) == {"starjax.polcy", "starjax.runtime.xla.requires"}
