"""Counts the code: lines, entries, classes, untyped parameters, commands, tests. No time.

    python benchmarks/house.py [--cases]

Reads the source by `ast` and `tokenize` and imports nothing of it: any commit can be
counted: `python benchmarks/house.py --root CHECKOUT`.
"""

import argparse
import ast
import io
import pathlib
import re
import subprocess
import sys
import tokenize
from collections.abc import Callable, Collection, Iterable

UNTYPED = {"Any", "object"}
BLANK = {
    *(tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.COMMENT),
    *(tokenize.ENDMARKER, tokenize.ENCODING),
}
FUNCTIONS = ast.FunctionDef | ast.AsyncFunctionDef
PRAGMA = re.compile(r"#\s*(noqa|fmt|type|pyright)")


def lines_of(text: str) -> tuple[int, int, int]:
    """Returns the lines of a module: all, with code, with a comment.

    A docstring is no code; a line with a comment behind code counts as both.
    """
    docstrings = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Module | ast.ClassDef | FUNCTIONS) and ast.get_docstring(node):
            docstrings.add(node.body[0].lineno)
    code, comments = set(), set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT:
            if not PRAGMA.match(token.string):
                comments.add(token.start[0])
        elif token.type not in BLANK:
            is_docstring = token.type == tokenize.STRING and token.start[0] in docstrings
            if not is_docstring:
                code |= set(range(token.start[0], token.end[0] + 1))
    return len(text.splitlines()), len(code), len(comments)


def is_untyped(node: ast.expr | None, names: Collection[str]) -> bool:
    """Returns True for one of the names, or a union with one of them."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        try:
            node = ast.parse(node.value, mode="eval").body
        except SyntaxError:
            return False
    if isinstance(node, ast.BinOp) and isinstance(node.op, ast.BitOr):
        return is_untyped(node.left, names) or is_untyped(node.right, names)
    if isinstance(node, ast.Attribute):
        return node.attr in names and node.attr[0].isupper()
    return isinstance(node, ast.Name) and node.id in names


def aliases(trees: Iterable[ast.Module]) -> set[str]:
    """Returns `Any`, `object` and the names that modules bind to one of them alone."""
    names = set(UNTYPED)
    for node in [node for tree in trees for node in tree.body]:
        target = node.targets[0] if isinstance(node, ast.Assign) else getattr(node, "target", None)
        if isinstance(target, ast.Name) and is_untyped(getattr(node, "value", None), names):
            names.add(target.id)
    return names


def untyped_parameters(tree: ast.Module, names: Collection[str]) -> int:
    """Returns the number of parameters, `*args` too, whose annotation is one of the names."""
    count = 0
    for node in ast.walk(tree):
        if isinstance(node, FUNCTIONS):
            a = node.args
            every = [*a.posonlyargs, *a.args, *a.kwonlyargs, *filter(None, (a.vararg, a.kwarg))]
            count += sum(is_untyped(arg.annotation, names) for arg in every)
    return count


def late_imports(tree: ast.Module) -> int:
    """Returns the number of imports inside functions."""
    functions = [node for node in ast.walk(tree) if isinstance(node, FUNCTIONS)]
    return len(
        {
            inner
            for function in functions
            for inner in ast.walk(function)
            if isinstance(inner, ast.Import | ast.ImportFrom)
        }
    )


def commands(root: pathlib.Path) -> tuple[int, int]:
    """Returns the number of subcommands in the core's help, and in add-ons' tables."""
    cli = root / "src/starjax/cli/__init__.py"
    file = cli if cli.is_file() else root / "src/starjax/cli/__init__.py"
    core = _keys(file, ("CORE", "_TABLE"))
    tables = sorted((root / "src/starjax/addons").glob("*/table.py"))
    return core, sum(_keys(table, ("commands",)) for table in tables)


def _keys(file: pathlib.Path, names: tuple[str, ...]) -> int:
    """Returns the number of keys of a dict that a module binds, or passes, under one of names."""
    for node in ast.walk(ast.parse(file.read_text())):
        name = getattr(node, "arg", None) or getattr(getattr(node, "target", None), "id", None)
        if isinstance(node, ast.Assign):
            name = getattr(node.targets[0], "id", None)
        value = getattr(node, "value", None)
        if name in names and isinstance(value, ast.Dict):
            return len(value.keys)
    return 0


def figures(root: pathlib.Path) -> dict[str, tuple[float, ...]]:
    """Returns name -> figures."""
    source, tests = (sorted((root / name).rglob("*.py")) for name in ("src", "tests"))
    trees = {path: ast.parse(path.read_text()) for path in source}
    sizes = {path: lines_of(path.read_text()) for path in (*source, *tests)}
    names = aliases(trees.values())
    package = root / "src/starjax"
    core = [path for path in source if package / "addons" not in path.parents]
    of_add_ons = {path for path in tests if root / "tests/addons" in path.parents}

    def total(paths: Iterable[pathlib.Path], i: int) -> int:
        return sum(sizes[path][i] for path in paths)

    def both(count: Callable[[ast.Module], int]) -> tuple[int, int]:
        inside, everywhere = (sum(count(trees[path]) for path in paths) for paths in (core, source))
        return inside, everywhere

    comments = [token for path in source for token in _comments(path.read_text())]
    top = [p for p in package.iterdir() if not p.name.startswith(("__pyc", "."))]
    core_tests = [path for path in tests if path not in of_add_ons]
    scripts = list((root / "benchmarks").glob("*.py"))
    return {
        "code lines: core, all": (total(core, 1), total(source, 1)),
        "lines of src: core, all": (total(core, 0), total(source, 0)),
        "entries at the top of src/starjax": (len(top),),
        "classes: core, all": both(
            lambda tree: sum(isinstance(n, ast.ClassDef) for n in ast.walk(tree))
        ),
        "parameters typed Any, object or an alias: core, all": both(
            lambda tree: untyped_parameters(tree, names)
        ),
        "imports inside functions: core, all": both(late_imports),
        "commands in the help: core, add-ons": commands(root),
        "lines with a comment, % of all lines": (
            round(100 * total(source, 2) / total(source, 0), 2),
        ),
        "lines with a comment, % of the core's code lines": (
            round(100 * total(core, 2) / total(core, 1), 2),
        ),
        "comments that begin with 'of'": (
            sum(bool(re.match(r"#:?\s*of\b", text)) for text in comments),
        ),
        "lines of tests: core, all": (total(core_tests, 0), total(tests, 0)),
        "scripts in benchmarks: bench_*, all": (
            sum(path.name.startswith("bench_") for path in scripts),
            len(scripts),
        ),
    }


def _comments(text: str) -> list[str]:
    tokens = tokenize.generate_tokens(io.StringIO(text).readline)
    return [token.string for token in tokens if token.type == tokenize.COMMENT]


def cases(root: pathlib.Path) -> tuple[int, int]:
    """Returns the number of test cases of the core and of all, as pytest collects them."""
    command = [sys.executable, "-m", "pytest", "--collect-only", "-q"]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, check=True)
    lines = [line for line in done.stdout.splitlines() if "::" in line]
    return sum(not line.startswith("tests/addons") for line in lines), len(lines)


def main() -> None:
    """Prints a table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--root", type=pathlib.Path, default=pathlib.Path(__file__).parents[1])
    parser.add_argument("--cases", action="store_true", help="count the cases of tests too")
    args = parser.parse_args()
    rows = figures(args.root)
    if args.cases:
        rows["cases of tests: core, all"] = cases(args.root)
    print("| | figures |\n|---|---:|")
    for name, values in rows.items():
        print(f"| {name} | {'; '.join(f'{value:,}' for value in values)} |")


if __name__ == "__main__":
    main()
