"""Imports point one way: each layer knows only those to its left (read from the source by ast)."""

import ast
import pathlib

import pytest

SOURCE = pathlib.Path(__file__).parents[1] / "src" / "starjax"
FOUNDATION = {"config", "types", "runtime"}
# Layer -> the layers that it may import, besides itself.
ALLOWED: dict[str, set[str]] = {
    "config": set(),
    "types": set(),
    "runtime": {"config"},
    "rcm": {"config", "types"},
    "models": FOUNDATION | {"rcm"},
    "sim": FOUNDATION | {"rcm"},
    "data": FOUNDATION | {"rcm", "sim"},
    "policies": FOUNDATION | {"rcm", "sim", "data", "models"},
    "training": FOUNDATION | {"rcm", "sim", "data", "models", "policies"},
    "evaluation": FOUNDATION | {"rcm", "sim", "data", "models", "policies"},
}
TOP = {"experiments", "deploy", "cli", "doctor", "__main__"}


def layer(path: pathlib.Path) -> str:
    return path.relative_to(SOURCE).parts[0].removesuffix(".py")


def imported(source: str) -> set[str]:
    """Layers of starjax that a module's source imports, wherever in it the import stands."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            continue
        found |= {name.split(".")[1] for name in names if name.startswith("starjax.")}
    return found - {"__version__"}


FILES = sorted(SOURCE.rglob("*.py"))


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(SOURCE)))
def test_imports_point_to_the_left(path):
    name = layer(path)
    if name in TOP:
        return
    allowed = ALLOWED.get(name, set()) | {name}
    assert imported(path.read_text()) <= allowed


def test_every_layer_has_a_place():
    names = {layer(path) for path in FILES} - {"__init__"}
    assert names <= set(ALLOWED) | TOP


def test_a_wrong_direction_is_seen():
    assert imported("def f():\n    from starjax.policies import policy") == {"policies"}
    assert imported("import starjax.sim.env") == {"sim"}


def test_only_training_checkpoint_knows_orbax():
    users = {
        str(path.relative_to(SOURCE))
        for path in FILES
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Import | ast.ImportFrom)
        and "orbax" in (getattr(node, "module", None) or node.names[0].name)
    }
    assert users <= {"training/checkpoint.py"}
