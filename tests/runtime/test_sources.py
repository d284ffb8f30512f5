"""Digests of code: edits that matter change them, others do not."""

import importlib
import sys

import pytest

from starjax.runtime import sources

TASK = "starjax.sim.tasks.{0}.task:TASK"


@pytest.fixture
def package(tmp_path, monkeypatch):
    """An installed package of two modules; returns its folder."""
    folder = tmp_path / "mylab"
    folder.mkdir()
    (folder / "__init__.py").touch()
    (folder / "lid.py").write_text("from mylab import angles\n\nTASK = angles.OPEN\n")
    (folder / "angles.py").write_text("OPEN = 60  # deg\n")
    info = tmp_path / "mylab-2.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: mylab\nVersion: 2.0\n")
    (info / "RECORD").write_text("mylab/__init__.py,,\n")
    (info / "entry_points.txt").write_text("[starjax.tasks]\nlid = mylab.lid:TASK\n")
    monkeypatch.syspath_prepend(tmp_path)
    importlib.invalidate_caches()
    yield folder
    sys.modules.pop("mylab", None)


def test_an_edit_of_any_module_of_a_package_changes_its_digest(package):
    before = sources.digests("mylab.lid:TASK")
    assert list(before) == ["mylab"] and sources.digests("mylab.lid:TASK") == before
    (package / "angles.py").write_text('"""Angles."""\n\nOPEN = 60\n')
    assert sources.digests("mylab.lid:TASK") == before  # a docstring and a comment
    (package / "angles.py").write_text("OPEN = 20  # deg\n")
    assert sources.digests("mylab.lid:TASK") != before


def test_the_version_of_a_package_is_recorded_and_counts(package):
    before = sources.digests("mylab.lid:TASK")
    assert sources.versions("mylab.lid:TASK", TASK.format("reach")) == {"mylab": "2.0"}
    metadata = package.parent / "mylab-2.0.dist-info" / "METADATA"
    metadata.write_text(metadata.read_text().replace("2.0", "2.1"))
    importlib.invalidate_caches()
    assert sources.digests("mylab.lid:TASK") != before


def test_tasks_of_starjax_have_digests_of_their_own_modules():
    each = {name: sources.digests(TASK.format(name)) for name in ("reach", "peg_transfer")}
    assert all(list(found) == ["starjax"] for found in each.values())
    assert each["reach"] != each["peg_transfer"]
    found = sources._closure(["starjax.sim.tasks.peg_transfer.expert"])
    assert {"starjax.sim.tasks.peg_transfer.task", "starjax.sim.tasks.scripting"} <= found
    assert "starjax.sim.tasks.base" not in found and "starjax.sim.tasks.reach.task" not in found
    assert sources.digests("starjax.sim.arms.fr5:ARM", "nowhere.at_all:X", "") == {}


def test_indentation_counts_and_its_width_does_not():
    def code(text):
        return sources._code(text.encode())

    deep = "if a:\n    b()\n    c()\n"
    assert code(deep) == code(deep.replace("    ", "  "))
    assert code(deep) != code("if a:\n    b()\nc()\n")
    assert code("x = 'text'\n") != code("x = 'other'\n")


def test_a_string_with_expressions_is_one_token_in_every_version_of_python():
    # Python 3.12 splits it; the expected text is that of 3.11.
    string = 'f"""é {a:{b}} {f\'{c!r}\'} {{d}}\n  end"""'
    expected = f"x = {string} NEWLINE y = 1 NEWLINE ENDMARKER"
    code = f"x = {string}  # why\ny = 1\n".encode()
    assert sources._code(code) == expected
    assert sources._code(code.replace(b"\n", b"\r\n")) == expected
