"""Versions of parts, and the digests of their code: edits that matter change them, others do not.

    python tests/runtime/test_sources.py    accepts today's code of every part of starjax

Accept code that gives the numbers of before (tests/test_goldens.py). Raise the version for others.
"""

import importlib
import json
import pathlib
import sys

import pytest

from starjax.core import errors, learners, sources
from starjax.evaluation.disturbances import DISTURBANCES
from starjax.sim import registries

WHERE = pathlib.Path("dataset.json")
KINDS = (
    *(registries.tasks, registries.arms, registries.tools, registries.rescuers),
    *(DISTURBANCES, learners.LEARNERS),
)


def parts() -> list[sources.Identity]:
    """All of starjax, and each task's experts."""
    found = [sources.identity(kind, name) for kind in KINDS for name in kind.built_in]
    for task in map(registries.tasks.get, registries.tasks.built_in):
        found += [
            sources.Identity(f"expert {task.name}.{name}", task.expert_version, code)
            for name, code in task.experts.items()
        ]
    return found


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
    monkeypatch.syspath_prepend(tmp_path)
    importlib.invalidate_caches()
    yield folder
    sys.modules.pop("mylab", None)


LID = sources.Identity("task lid", 1, "mylab.lid:TASK")


def test_other_code_under_an_equal_version_is_refused(package):
    before = sources.record([LID])
    assert before["parts"] == {"task lid": 1}
    (package / "angles.py").write_text('"""Angles."""\nimport math\n\nOPEN = 60\n')
    sources.refuse_other_code(WHERE, before, sources.record([LID]))  # no number has changed
    (package / "angles.py").write_text("OPEN = 20  # deg\n")
    with pytest.raises(errors.UsageError) as refused:
        sources.refuse_other_code(WHERE, before, sources.record([LID]))
    assert refused.value.argument == "task lid" and "\n" not in str(refused.value)
    sources.refuse_other_code(WHERE, before, sources.record([LID._replace(version=2)]))
    sources.refuse_other_code(WHERE, {}, sources.record([LID]))  # a file without versions


def test_packages_of_others_have_their_version(package):
    reach = sources.identity(registries.tasks, "reach")
    assert sources.packages([LID, reach]) == {"mylab": "2.0"}
    assert sources.record([sources.identity(registries.tasks, "nowhere")]) == {
        "parts": {},
        "source": {},
    }


def test_code_of_a_task_is_that_of_its_modules_and_of_those_of_tasks_that_they_import():
    files = {file.parent.name for file in sources._modules("starjax.tasks.reach.task")}
    assert files == {"reach", "tasks"} and not any(
        file.name == "base.py" for file in sources._modules("starjax.tasks.reach.task")
    )


@pytest.mark.parametrize("part", parts(), ids=lambda part: part.name)
def test_code_of_starjax_is_accepted_under_its_version(part):
    version, *digests = json.loads(sources.ACCEPTED.read_text()).get(part.name, [0])
    now = sources.record([part])["source"][part.name]
    assert (version, now) == (part.version, digests[0]), (
        f"the code of {part.name} has changed: raise its version, or accept equal code, see above"
    )


def test_an_accepted_digest_stands_for_the_first_one(package, monkeypatch):
    first = sources.record([LID])["source"]["task lid"]
    (package / "angles.py").write_text("OPEN = 50 + 10\n")
    second = sources.record([LID])["source"]["task lid"]
    monkeypatch.setattr(sources, "_accepted", lambda: {"task lid": [1, first, second]})
    assert first != second and sources.record([LID])["source"] == {"task lid": first}
    again = sources.record([LID._replace(version=2)])["source"]
    assert again == {"task lid": second}  # digest of another version


@pytest.mark.parametrize(
    ("code", "other", "is_same"),
    [
        ("if a:\n    b()\n    c()\n", "if a:\n  b()\n  c()\n", True),
        ("if a:\n    b()\n    c()\n", "if a:\n    b()\nc()\n", False),
        ("x = 'text'\n", 'x = "text"  # why\n', True),
        ("x = 'text'\n", "x = 'other'\n", False),
        ("from a import b, c\nb(c)\n", "from d import c, b\nb(c)\n", True),
        ("def f():\n    '''Text.'''\n    return 1\n", "def f():\n    return 1\n", True),
        ("x = f'{a!r} {b:{c}}'\n", "x = f'{a!s} {b:{c}}'\n", False),
    ],
)
def test_tokens_that_compute_count(code, other, is_same):
    assert (sources._code(code.encode()) == sources._code(other.encode())) == is_same


def test_the_text_of_code_is_the_same_in_every_version_of_python():
    a, b = (f"Name(id='{name}', ctx=Load())" for name in "ab")
    width = f"JoinedStr(values=[Constant(value='>'), FormattedValue(value={b}, conversion=-1)])"
    value = f"FormattedValue(value={a}, conversion=-1, format_spec={width})"
    expected = f"Module(body=[Expr(value=JoinedStr(values=[{value}]))])"
    assert sources._code(b"f'{a:>{b}}'") == expected


def accept() -> None:
    """Writes the digests of today's code: one more of an equal version, else the only one."""
    table = json.loads(sources.ACCEPTED.read_text()) if sources.ACCEPTED.exists() else {}
    sources._accepted = dict  # digests as they are
    for part in parts():
        digest = sources.record([part])["source"][part.name]
        version, *before = table.get(part.name, [0])
        same = before if version == part.version else []
        table[part.name] = [part.version, *dict.fromkeys([*same, digest])]
    rows = [f" {json.dumps(name)}: {json.dumps(table[name])}" for name in sorted(table)]
    sources.ACCEPTED.write_text("{\n" + ",\n".join(rows) + "\n}\n")


if __name__ == "__main__":
    accept()
