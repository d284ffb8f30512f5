"""Imports point one way: each layer imports those to its left only (read by ast)."""

import ast
import pathlib

SOURCE = pathlib.Path(__file__).parents[1] / "src" / "starjax"
# From left to right; a layer may import itself and those of the rows before its own.
ROWS = (
    ("core",),
    ("rcm", "runtime"),
    ("sim",),
    ("tasks",),
    ("data",),
    ("policies",),
    ("evaluation",),
    ("training",),
    ("deploy", "envs"),
    ("report",),
    ("cli",),
    ("addons",),
)
COMMANDS = {"cli", "experiments", "testing", "__main__"}  # one layer
PLACE = {name: row for row, names in enumerate(ROWS) for name in names}


def layer(path: pathlib.Path) -> str:
    return named(path.relative_to(SOURCE).parts[0].removesuffix(".py"))


def named(part: str) -> str:
    return "cli" if part in COMMANDS else part


def imported(source: str) -> set[str]:
    """Layers of starjax that a module's source imports, wherever in it the import stands."""
    return {named(name.split(".")[1]) for name in names(source)} - {"__version__"}


def names(source: str) -> set[str]:
    """Modules and objects of starjax that a module's source imports."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return {name for name in found if name.startswith("starjax.")}


FILES = sorted(path for path in SOURCE.rglob("*.py") if layer(path) != "__init__")


def test_imports_point_to_the_left():
    for path in FILES:
        name = layer(path)
        right = {other for other in imported(path.read_text()) if PLACE[other] >= PLACE[name]}
        assert right <= {name}, path


def test_the_simulator_does_not_know_its_rollouts():
    for path in set((SOURCE / "sim").rglob("*.py")) - set((SOURCE / "sim/rollouts").rglob("*.py")):
        found = names(path.read_text())
        assert not any(name.startswith("starjax.sim.rollouts") for name in found), path


def test_add_ons_do_not_know_each_other():
    for path in (SOURCE / "addons").glob("*/**/*.py"):
        own = path.relative_to(SOURCE / "addons").parts[0]
        of_add_ons = {n for n in names(path.read_text()) if n.startswith("starjax.addons.")}
        assert {name.split(".")[2] for name in of_add_ons} <= {own}, path


def test_tables_of_add_ons_import_nothing_but_their_record():
    for path in (SOURCE / "addons").glob("*/table.py"):
        imports = [n for n in ast.walk(ast.parse(path.read_text())) if hasattr(n, "names")]
        assert [node.module for node in imports] == ["starjax.core.extensions"], path


def test_every_layer_has_a_place():
    assert {layer(path) for path in FILES} <= set(PLACE)


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
