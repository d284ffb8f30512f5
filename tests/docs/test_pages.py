"""Programs of the documentation run, its commands parse, its links and files exist."""

import contextlib
import importlib.util
import io
import itertools
import json
import re
import shlex
import tomllib

import pytest

from starjax import cli, rcm
from starjax.addons.formats import mapping
from starjax.addons.formats.base import FORMATS
from starjax.addons.robots import robot_file
from starjax.cli import presets
from starjax.core import errors, methods
from starjax.core.learners import LEARNERS
from starjax.evaluation.disturbances import DISTURBANCES
from starjax.sim import registries

FENCE = re.compile(r"^```(\w+)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
HEADER = re.compile(r"\A---\n(.*?)\n---\n", re.DOTALL)
SNIPPET = re.compile(r'^--8<-- "([^":]+)"$', re.MULTILINE)
INCLUDED = re.compile(r"^<!-- (\S+\.\w+) -->\n```\w+\n(.*?)^```$", re.DOTALL | re.MULTILINE)
LINK = re.compile(r"\]\(([^)#\s]+)(?:#[^)\s]*)?\)")


@pytest.fixture(scope="module")
def root(pytestconfig):
    return pytestconfig.rootpath


def found(root):
    """Every page that a person wrote."""
    pages = (*root.glob("docs/**/*.md"), *root.glob("src/starjax/addons/*/README.md"))
    return [*sorted(pages), root / "README.md", root / "CONTRIBUTING.md"]


def pytest_generate_tests(metafunc):
    root = metafunc.config.rootpath
    if "page" in metafunc.fixturenames:
        pages = [page for page in found(root) if wanted(metafunc.function, page)]
        names = [str(page.relative_to(root)) for page in pages]
        if metafunc.function is test_programs_run:
            pages = [marked(page) for page in pages]
        metafunc.parametrize("page", pages, ids=names)


def wanted(function, page):
    languages = {language for language, _ in FENCE.findall(page.read_text())}
    needed = {
        test_programs_run: "python",
        test_commands_parse: "bash",
        test_configurations_are_read: "toml",
    }.get(function)
    return needed is None or needed in languages


def marked(page):
    """A page as a parameter; its header may say `tests: slow` and `needs: PACKAGE`."""
    header = HEADER.match(page.read_text())
    said = dict(line.split(": ", 1) for line in header[1].splitlines()) if header else {}
    package = said.get("needs")
    # Its first program runs in tests/test_alone.py.
    marks = [pytest.mark.release] if said.get("tests") == "slow" else []
    if package and not importlib.util.find_spec(package):
        marks.append(pytest.mark.skip(reason=f"{package} is not installed"))
    return pytest.param(page, marks=marks)


def test_programs_run(page, tmp_path, monkeypatch):
    """The blocks of a page are one program, so each continues the one before."""
    monkeypatch.chdir(tmp_path)
    names = {"__name__": page.stem}
    text = page.read_text()
    for block in FENCE.finditer(text):
        if block[1] == "python":
            line = text[: block.start()].count("\n") + 1
            exec(compile("\n" * line + block[2], str(page), "exec"), names)


def test_configurations_are_read(page, tmp_path):
    """Entry points are of known groups, an arm is a robot, anything else maps a dataset."""
    kinds = (registries.tasks, registries.arms, registries.tools, registries.workspaces, LEARNERS)
    groups = {f"starjax.{one.kind}s" for one in (*kinds, FORMATS, DISTURBANCES)}
    rows = (methods.METHODS, rcm.ACTION_SPACES, presets.PRESETS)
    groups |= {f"starjax.{one.registry.kind}s" for one in rows} | {
        "starjax.policies",
        "starjax.mounts",
    }
    for block in blocks(page, "toml"):
        found = tomllib.loads(block)
        if "project" in found:
            assert found["project"]["entry-points"].keys() <= groups
        elif "arm" in found:
            (tmp_path / "robot.toml").write_text(block)
            assert robot_file.read(tmp_path / "robot.toml").cameras
        else:
            (tmp_path / "map.toml").write_text(block)
            assert mapping.load(tmp_path / "map.toml").task in registries.tasks.names()


def blocks(page, language):
    """Blocks of a page in a language."""
    for found, block in FENCE.findall(page.read_text()):
        if found == language:
            yield block


def commands(page, root):
    """(command, flags and their values) of all `starjax` lines of a page's shell blocks."""
    for block in blocks(page, "bash"):
        for line in block.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            for i, word in enumerate(words):
                module = re.fullmatch(r"starjax\.experiments\.(\w+)", word)
                if module or word.rpartition("/")[2] == "starjax":
                    yield [module[1], *words[i + 1 :]] if module else words[i + 1 :]


@pytest.fixture(scope="module")
def flags():
    """Command -> its flags -> the choices of each, read from its help."""
    found = {}
    for name in cli.COMMANDS:
        said = io.StringIO()
        with contextlib.suppress(SystemExit), contextlib.redirect_stdout(said):
            cli.dispatch([name, "--help-all"])
        text = re.sub(r"\x1b\[[0-9;]*m", "", said.getvalue())
        found[name] = dict(re.findall(r"(--\w[\w.-]+)(?: \{([\w,]+)\})?", text))
    return found


def test_commands_parse(page, root, flags):
    for name, *words in commands(page, root):
        if name in ("--help", "--version"):
            continue
        errors.choice("COMMAND", name, cli.COMMANDS)
        for word, value in itertools.zip_longest(words, words[1:]):
            if word.startswith("--"):
                errors.choice(f"{name}: flag", word, flags[name])
                choices = flags[name][word]
                assert not choices or value in choices.split(","), (word, value)


def test_links_lead_somewhere(page):
    """Links work in a checkout; the site's builder rewrites those that leave docs/."""
    for target in LINK.findall(FENCE.sub("", page.read_text())):
        assert "://" in target or (page.parent / target).exists(), target


def test_groups_of_entry_points_exist(page, root):
    groups = json.loads((root / "tests/golden/identity/groups.json").read_text())
    named = r"(?:group |entry-points\.)[`\"](starjax\.\w+)"
    assert set(re.findall(named, page.read_text())) <= set(groups)


def test_included_files_are_as_they_are(page, root):
    """A page has the text of a file, which the repository's own view shows too."""
    text = page.read_text()
    assert not SNIPPET.search(text)
    for path, block in INCLUDED.findall(text):
        assert block.strip() == (root / path).read_text().strip(), path


def test_readme_is_short(root):
    assert len((root / "README.md").read_text().splitlines()) <= 110
