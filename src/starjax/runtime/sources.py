"""Digests of the Python code that a part consists of, and the packages that provide it.

An edited task or expert makes its demonstrations and results stale, as an edited MJCF does.
"""

import ast
import functools
import hashlib
import importlib.metadata
import importlib.util
import io
import tokenize
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

_OURS = "starjax"
# Of starjax, the modules of tasks alone: an edit of another module leaves demonstrations valid.
_TASKS = ("starjax.sim.tasks.", "starjax.addons.")
_SHARED = frozenset({"starjax.sim.tasks.base"})  # the interface
_DIGITS = 16
_SKIPPED = (tokenize.COMMENT, tokenize.NL)
_STATEMENT_ENDS = (tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT)
# A string with expressions is several tokens from Python 3.12 on, one before.
_STRING_STARTS, _STRING_ENDS = (
    tuple(getattr(tokenize, f"{kind}STRING_{end}", None) for kind in "FT")
    for end in ("START", "END")
)


def digests(*parts: Any) -> dict[str, str]:
    """Returns the digest of the code of each package that provides the parts.

    Args:
      parts: functions, or names of objects as `module:object`.

    A package's digest covers its version and all its modules; starjax's covers the modules of the
    task and those of tasks that these import. Comments and docstrings do not count.
    """
    by_package: dict[str, set[str]] = {}
    for module in _modules(parts):
        by_package.setdefault(module.partition(".")[0], set()).add(module)
    found = {}
    for package, modules in sorted(by_package.items()):
        if package != _OURS:
            files = _files_of(package)
        else:
            tasks = _closure(name for name in modules if name.startswith(_TASKS))
            files = tuple(filter(None, map(_file, sorted(tasks))))
        if files:
            found[package] = digest(version(package) if package != _OURS else "", files)
    return found


def versions(*parts: Any) -> dict[str, str]:
    """Returns the versions of the packages other than starjax that provide the parts."""
    return {name: version(name) for name in digests(*parts) if name != _OURS}


def version(package: str) -> str:
    """Returns the version of the distribution that installs an import package, or empty."""
    owners = importlib.metadata.packages_distributions().get(package, ())
    return importlib.metadata.version(owners[0]) if owners else ""


def _modules(parts: Iterable[Any]) -> set[str]:
    """Returns the modules that define objects."""
    modules = (
        part.partition(":")[0] if isinstance(part, str) else getattr(part, "__module__", "")
        for part in parts
    )
    return set(filter(None, modules)) - _SHARED


def _closure(modules: Iterable[str]) -> set[str]:
    """Returns modules of tasks with those of tasks that they import."""
    found, waiting = set(), list(modules)
    while waiting:
        name = waiting.pop()
        path = _file(name)
        if name not in found and path is not None:
            found.add(name)
            waiting += [x for x in _imports(path) if x.startswith(_TASKS) and x not in _SHARED]
    return found


def _imports(path: Path) -> Iterator[str]:
    """Yields the names that a module imports; some are objects of modules."""
    for node in ast.walk(ast.parse(path.read_bytes())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def _file(module: str) -> Path | None:
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, ValueError):
        return None
    is_source = spec is not None and spec.origin is not None and spec.origin.endswith(".py")
    return Path(spec.origin) if is_source else None  # type: ignore


def _files_of(package: str) -> tuple[Path, ...]:
    """Returns the files of all modules of an import package, which may be one file."""
    path = _file(package)
    if path is None:
        return ()
    return tuple(sorted(path.parent.rglob("*.py"))) if path.name == "__init__.py" else (path,)


def digest(prefix: str, files: Iterable[Path]) -> str:
    """Returns the digest of a text and of the code in files, without comments and docstrings."""
    total = hashlib.sha256(prefix.encode())
    for path in files:
        total.update(f"\n{path.name}\n{_code(path.read_bytes())}".encode())
    return total.hexdigest()[:_DIGITS]


@functools.lru_cache(maxsize=1024)
def _code(content: bytes) -> str:
    """Returns the tokens of a module without comments and docstrings."""
    try:
        tokens = [token for token in _tokens(content) if token.type not in _SKIPPED]
    except (tokenize.TokenError, SyntaxError):
        return content.decode(errors="replace")
    kept, is_docstring = [], False
    for i, token in enumerate(tokens):
        if is_docstring:  # its line end
            is_docstring = False
            continue
        begins = i == 0 or tokens[i - 1].type in _STATEMENT_ENDS
        ends = i + 1 < len(tokens) and tokens[i + 1].type in (tokenize.NEWLINE, tokenize.ENDMARKER)
        is_docstring = token.type == tokenize.STRING and begins and ends
        if not is_docstring:
            # An indentation's string is its blanks, which do not count.
            kept.append(token.string.strip() or tokenize.tok_name[token.type])
    return " ".join(kept)


def _tokens(content: bytes) -> Iterator[tokenize.TokenInfo]:
    """Yields the tokens of a module, every string as one, in any version of Python and line end."""
    encoding, _ = tokenize.detect_encoding(io.BytesIO(content).readline)
    lines = list(io.StringIO(content.decode(encoding), newline=None))
    depth, start = 0, (1, 0)
    for token in tokenize.generate_tokens(iter(lines).__next__):
        if token.type in _STRING_STARTS:
            start = start if depth else token.start
            depth += 1
        elif token.type in _STRING_ENDS:
            depth -= 1
            token = token._replace(
                type=tokenize.STRING, string=_between(lines, start, token.end), start=start
            )
        if not depth:
            yield token


def _between(lines: list[str], start: tuple[int, int], end: tuple[int, int]) -> str:
    """Returns the text between two positions: row, from 1, and column."""
    part = lines[start[0] - 1 : end[0]]
    part[-1] = part[-1][: end[1]]
    part[0] = part[0][start[1] :]
    return "".join(part)
