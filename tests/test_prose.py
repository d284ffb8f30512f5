"""English of docstrings, comments, messages and pages: budgets of expressions, which only fall.

The expressions find turns of phrase that a reader of this field has to read twice. A budget of zero
is a rule. Lower the others whenever a count falls.
"""

import ast
import collections
import functools
import io
import pathlib
import re
import tokenize

import pytest

ROOT = pathlib.Path(__file__).parents[1]
SOURCE = sorted((ROOT / "src").rglob("*.py"))
PAGES = [
    path
    for path in (
        ROOT / "README.md",
        ROOT / "CONTRIBUTING.md",
        ROOT / "CHANGELOG.md",
        *sorted((ROOT / "docs").rglob("*.md")),
    )
    if "api" not in path.parts
]
# Code and pages outside the package.
BESIDE = {
    name: [
        path
        for kind in ("py", "md", "toml")
        for path in sorted((ROOT / name).rglob(f"*.{kind}"))
        if path != pathlib.Path(__file__)  # its expressions are data
    ]
    for name in ("tests", "benchmarks", "experiments")
}
FIRST_WORDS = re.compile(r"^(What|Which|Whether|How|Where|When|Why|Who(ever)?)\b")

PATTERNS = {
    "ATTR": r"^[\w, ]+: (what|which|whether|how|where|who|when|why)\b",
    "WHAT": r"\b(what|whatever|whoever|whichever)\b",
    "NONE": (
        r"\b(is|are|was|has|have|that|there is) none\b|\bthere (is|are|was) no(ne|thing)\b"
        r"|\bthat (is|are) no \w|\bif it is one\b"
    ),
    "THERE": (r"\b(is|are|was|were|not|already|what is) there\b(?! (is|are|was|a|an|no)\b)"),
    "IDIOM": (
        r"\b(in the main|as ever|by luck|of one's own|the whole of it|(all|most|more) of it"
        r"|slip of the hand|at last|by heart|somebody|nobody|anybody)\b"
    ),
    "GO_ON": r"\b(go|goes|going|went|gone) on\b",
    "BESIDE": r"\b[Bb]eside\b",
    "SPLICE": (
        r"[a-z`)], (it|they|this|these) "
        r"(is|are|was|has|have|does|do|would|will|can|may|must|cannot)\b"
    ),
    "INVERTED": (
        r"(^|\. )(Of|Beside|From there|With it) [a-z`][^.,]{2,60}"
        r"|\bas (is|are|do|does) (the|that|those|its)\b|, so (is|are|does|do) (it|they|its|both)\b"
    ),
    "ANTHRO": (
        r"\b(hears?|heard|wish(es)?|told|tells|is said|asks? for|asked for|speaks?|obeys?|knows?)\b"
    ),
    "SO_THAT": (
        r"\bso that\b|, as (it|they|its|no|if|there|this|that|these|two|both|most|nothing|others)\b"
    ),
    "EACH": r", an? \w+ each\b|\b(one|an? \w+) for each\b|\b(one|two) each\b",
    "PER": (
        r"\b(samples?|rows?|lines?|kernels?|steps?|pixels|trials?|commands?|demonstrations?|plan"
        r"|sentence|column|file|folder|training) an? (training|side|sample|step|trial|trocar|group"
        r"|learner|episode|method|row|frame|second|plan|claim|field|moment|device|line)\b"
    ),
    "IS_TO": r"\b(is|are|was|were) to (be|go|see|do|reach|hang|stand|come|hold)\b",
    "WHERE": (
        r"\b[Ww]here (there|nothing|none|no|it (has|is|was|fails|does|may)|they (are|have|do))\b"
    ),
    "LEFT_OUT": r"\bbut for\b|\bleft out\b",
    "ARTICLE": (
        r"\b(between|of|with|by) (trocar|tip|pose|shaft|arm|tool|board|handle|needle|block)"
        r" (and|or) (the )?(trocar|tip|pose|shaft|arm|tool|hotkeys|gripper|plan|arms|pads)\b"
        r"|\btouched board\b"
    ),
}
# First words in -s that are no verbs in the third person.
PLURALS = set(
    """Address Arrays As Bodies Cameras Centres Chunks Colours Columns Commands Devices Entries
    Episodes Features Fields Figures Forces Formats Frames Images Indices Inputs Its Jaws Labels
    Lanes Limits Lines Matrices Means Names Numbers Openings Options Pairs Parameters Paths Pegs
    Poses Positions Radius Ranges Rollouts Rotations Rows Seconds Seeds Sequences Settings Shapes
    Shardings Sides Sizes Statistics Status Steps Success Successes Tables Tasks Taps Texels
    Textures This Tiles Times Tokens Trials Trocars Values Vectors Versions Vertices Warnings
    Words""".split()  # noqa: SIM905
)
COMPILED = {name: re.compile(pattern) for name, pattern in PATTERNS.items()}
# Highest counts in src and in pages.
BUDGETS = {
    "ATTR": (0, 0),
    "WHAT": (35, 0),
    "NONE": (0, 0),
    "THERE": (5, 0),
    "IDIOM": (0, 0),
    "GO_ON": (0, 0),
    "BESIDE": (3, 0),
    "SPLICE": (0, 0),
    "INVERTED": (2, 0),
    "ANTHRO": (5, 0),
    "SO_THAT": (6, 0),
    "EACH": (2, 1),
    "PER": (2, 0),
    "IS_TO": (1, 0),
    "WHERE": (6, 0),
    "LEFT_OUT": (12, 1),
    "ARTICLE": (0, 0),
}
# Highest counts in tests, benchmarks and experiments.
BESIDE_BUDGETS = {
    "ATTR": (8, 2, 0),
    "WHAT": (37, 14, 0),
    "NONE": (1, 0, 0),
    "THERE": (2, 0, 0),
    "IDIOM": (9, 0, 0),
    "GO_ON": (0, 0, 0),
    "BESIDE": (7, 6, 0),
    "SPLICE": (0, 0, 0),
    "INVERTED": (5, 2, 0),
    "ANTHRO": (12, 2, 0),
    "SO_THAT": (5, 2, 0),
    "EACH": (0, 1, 0),
    "PER": (0, 4, 0),
    "IS_TO": (0, 0, 0),
    "WHERE": (6, 1, 0),
    "LEFT_OUT": (2, 1, 0),
    "ARTICLE": (0, 1, 1),
}
# Highest numbers of comments that begin with "of" in src, tests, benchmarks and experiments.
OF = (0, 16, 8, 0)
# Most bullets of a version in the changelog, and words of a bullet.
BULLETS, WORDS = 60, 25
# Highest numbers of first docstring lines that begin with a question word, of functions without a
# verb in front, and of names that several classes share.
OPEN, VERBLESS, HOMONYMS = 0, 0, 0


@functools.cache
def lines_of_page(path: pathlib.Path) -> list[str]:
    """Lines of a Markdown page without code."""
    fence = re.compile(r"(?ms)^\s*```.*?^\s*```[^\n]*$")
    text = fence.sub(lambda match: "\n" * match[0].count("\n"), path.read_text())
    return re.sub(r"`[^`\n]*`", "`x`", text).split("\n")


@functools.cache
def lines_of_source(path: pathlib.Path) -> list[tuple[str, str]]:
    """(kind, line) of the docstrings, messages and comments of a module."""
    source = path.read_text()
    docstrings, lines = set(), []
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(
            node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
        ) and ast.get_docstring(node):
            assert isinstance(node.body[0], ast.Expr)
            docstrings.add(node.body[0].value)
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            is_docstring = node in docstrings
            if is_docstring or re.search("[a-z] [a-z]", node.value):
                kind = "doc" if is_docstring else "message"
                lines += [(kind, line.strip()) for line in node.value.split("\n")]
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT and not re.match(
            r"#\s*(noqa|fmt|type|pyright)", token.string
        ):
            lines.append(("comment", token.string.lstrip("# ")))
    return lines


def lines_of(path: pathlib.Path) -> list[str]:
    """Lines of prose of a module, a page or a claim."""
    if path.suffix == ".py":
        return [line for _, line in lines_of_source(path)]
    return lines_of_page(path)


@functools.cache
def first_lines(path: pathlib.Path) -> list[tuple[ast.AST, str]]:
    """(node, first docstring line) of a module's definitions."""
    return [
        (node, docstring.split("\n")[0])
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef)
        and (docstring := ast.get_docstring(node))
    ]


def count(lines: list[str]) -> dict[str, int]:
    """Occurrences of each expression."""
    return {
        name: sum(len(pattern.findall(line)) for line in lines)
        for name, pattern in COMPILED.items()
    }


def is_property(node: ast.AST) -> bool:
    """True for a function that is read as an attribute."""
    names = {
        ast.unparse(decorator).split(".")[-1] for decorator in getattr(node, "decorator_list", ())
    }
    return bool(names & {"property", "cached_property"})


def begins_with_verb(line: str) -> bool:
    """True if the first word is a verb in the third person, such as "Returns"."""
    word = re.match(r"[A-Za-z]+", line)
    return bool(word) and word[0].endswith("s") and word[0] not in PLURALS


def verbless(path: pathlib.Path) -> list[str]:
    """First lines of functions' docstrings that begin without a verb."""
    return [
        line
        for node, line in first_lines(path)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        and not is_property(node)
        and not begins_with_verb(line)
    ]


@pytest.mark.parametrize("name", PATTERNS)
def test_expressions_stay_within_their_budget(name):
    in_source = [line for path in SOURCE for _, line in lines_of_source(path)]
    in_pages = [line for path in PAGES for line in lines_of_page(path)]
    pattern = COMPILED[name]
    found = [sum(len(pattern.findall(line)) for line in lines) for lines in (in_source, in_pages)]
    assert all(x <= most for x, most in zip(found, BUDGETS[name], strict=True)), found


@pytest.mark.parametrize("name", PATTERNS)
def test_expressions_beside_the_package_stay_within_their_budget(name):
    found = tuple(
        sum(len(COMPILED[name].findall(line)) for path in paths for line in lines_of(path))
        for paths in BESIDE.values()
    )
    assert all(x <= most for x, most in zip(found, BESIDE_BUDGETS[name], strict=True)), found


def test_comments_begin_with_a_noun_or_a_verb():
    found = tuple(
        sum(
            kind == "comment" and line[:3].lower() == "of "
            for path in paths
            if path.suffix == ".py"
            for kind, line in lines_of_source(path)
        )
        for paths in (SOURCE, *BESIDE.values())
    )
    assert all(x <= most for x, most in zip(found, OF, strict=True)), found


def test_the_changelog_is_short():
    versions = re.split(r"^## ", (ROOT / "CHANGELOG.md").read_text(), flags=re.MULTILINE)[1:]
    for version in versions:
        bullets = re.findall(r"^- (.*(?:\n  .*)*)", version, re.MULTILINE)
        assert 0 < len(bullets) <= BULLETS, version[:10]
        for bullet in bullets:
            words = re.sub(r"\]\([^)]*\)", "]", bullet).split()
            assert len(words) <= WORDS, bullet


def test_no_docstring_begins_with_a_question_word():
    found = [
        (path.name, line)
        for path in SOURCE
        for _, line in first_lines(path)
        if FIRST_WORDS.match(line)
    ]
    assert len(found) <= OPEN, found


def test_docstrings_of_functions_begin_with_a_verb():
    found = [(path.name, line) for path in SOURCE for line in verbless(path)]
    assert len(found) <= VERBLESS, found


def test_no_two_classes_share_a_name():
    counts = collections.Counter(
        node.name
        for path in SOURCE
        for node in ast.parse(path.read_text()).body
        if isinstance(node, ast.ClassDef)
    )
    assert sum(number > 1 for number in counts.values()) <= HOMONYMS


def test_a_turn_of_phrase_is_seen():
    assert count(["What it knows, where nothing is wrong"])["WHAT"] == 0  # begins with a capital
    assert count(["seed: what is told"])["ATTR"] == 1
    assert not begins_with_verb("Names of the policies") and begins_with_verb("Lists policies")
