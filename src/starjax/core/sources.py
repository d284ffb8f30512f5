"""Identity of a part: its version, and the digest of its code, in case that is forgotten.

A task, expert, arm, tool, disturbance or learner has a `version`, which datasets and results are
found by. The digest of its code is recorded with it: other code under an equal version is refused.
Imports, docstrings, comments and the places of files do not count. Each digest in a row of
`accepted.json` stands for the row's first: code that was rewritten and gives the same numbers.
"""

import ast
import functools
import hashlib
import importlib.metadata
import importlib.util
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from starjax.core import errors
from starjax.core.registry import Registry

ACCEPTED = Path(__file__).with_name("accepted.json")
_OURS = "starjax"
# In starjax, a part's code is that of its modules in these packages, without the interfaces.
_PARTS = (
    *("starjax.tasks.", "starjax.sim.arms.", "starjax.sim.tools.", "starjax.addons."),
    *("starjax.evaluation.disturbances.", "starjax.policies.learners."),
)
_DIGITS = 16


class Identity(NamedTuple):
    """Identity of a part.

    Attributes:
      name: kind and name, e.g. `task reach`.
      version: of its record.
      code: `module:object`, or a function; empty for data and unknown parts.
    """

    name: str
    version: int
    code: str | Callable


def identity(registry: Registry, name: str) -> Identity:
    """Returns the identity of a part of a `registry.Registry`; records without a version have 1."""
    path = registry.path(name)
    version = getattr(path and registry.get(name), "version", 1)
    return Identity(f"{registry.kind} {name}", version, path)


def record(parts: Iterable[Identity]) -> dict[str, Any]:
    """Returns versions and digests of parts, for files.

    Returns:
      {"parts": name -> version, "source": name -> digest of the parts with code to compare}.
    """
    known = [part for part in parts if part.code]
    digests = {part.name: _digest_of(part) for part in known}
    return {
        "parts": {part.name: part.version for part in known},
        "source": {name: digest for name, digest in digests.items() if digest},
    }


def refuse_other_code(where: Path, before: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Raises UsageError for a part whose code has changed under an equal version.

    Args:
      where: file of `before`.
      before, now: contents with the values of `record`; older ones lack them.
    """
    for name, digest in now.get("source", {}).items():
        known = before.get("source", {}).get(name, digest)
        version = before.get("parts", {}).get(name)
        if known != digest and version == now["parts"][name]:
            got = f"other code of version {version}"
            raise errors.UsageError(name, f"that of {where}", got, f"raise the version of {name}")


def packages(parts: Iterable[Identity]) -> dict[str, str]:
    """Returns the versions of the packages other than starjax that provide parts."""
    names = {_module(part).partition(".")[0] for part in parts} - {_OURS, ""}
    return {name: version(name) for name in sorted(names)}


def version(package: str) -> str:
    """Returns the version of the distribution that installs an import package, or empty."""
    owners = importlib.metadata.packages_distributions().get(package, ())
    return importlib.metadata.version(owners[0]) if owners else ""


def digest(files: Iterable[Path]) -> str:
    """Returns the digest of the code in files."""
    code = sorted(_code(path.read_bytes()) for path in files)
    return hashlib.sha256("\n".join(code).encode()).hexdigest()[:_DIGITS]


def _digest_of(part: Identity) -> str:
    """Returns the digest of a part's code, or the one that it is accepted for."""
    module = _module(part)
    package = module.partition(".")[0]
    files = _modules(module) if package == _OURS else _files_of(package)
    found = digest(files) if files else ""
    row = _accepted().get(part.name, [0])
    return row[1] if [part.version] == row[:1] and found in row else found


@functools.cache
def _accepted() -> dict[str, list]:
    """Returns the parts of starjax: name -> version and digests of equal meaning."""
    return json.loads(ACCEPTED.read_text())


def _module(part: Identity) -> str:
    code = part.code
    return code.partition(":")[0] if isinstance(code, str) else getattr(code, "__module__", "")


def _modules(name: str) -> tuple[Path, ...]:
    """Returns the files of a module of parts and of those that it imports."""
    found, waiting = {}, [name]
    while waiting:
        name = waiting.pop()
        is_part = name.startswith(_PARTS) and not name.endswith(".base")
        path = _file(name) if is_part and name not in found else None
        if path is not None:
            found[name] = path
            waiting += _imports(path)
    return tuple(found.values())


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
    return tuple(path.parent.rglob("*.py")) if path.name == "__init__.py" else (path,)


@functools.lru_cache(maxsize=1024)
def _code(content: bytes) -> str:
    """Returns the syntax tree of a module as text, the same in every version of Python."""
    try:
        return _text(ast.parse(content))
    except (SyntaxError, ValueError):
        return content.decode(errors="replace")


def _text(node: Any) -> str:
    """Returns a syntax tree as text, without imports, docstrings and empty fields."""
    if isinstance(node, list):
        texts = [_text(item) for item in node if not _is_aside(item)]
        return f"[{', '.join(texts)}]" if texts else ""
    if not isinstance(node, ast.AST):
        return "" if node is None else repr(node)
    if isinstance(node, ast.JoinedStr):  # Python 3.12 ends some by an empty text
        node.values = [value for value in node.values if getattr(value, "value", None) != ""]
    fields = [f"{name}={text}" for name, value in ast.iter_fields(node) if (text := _text(value))]
    return f"{type(node).__name__}({', '.join(fields)})"


def _is_aside(node: Any) -> bool:
    is_text = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    return is_text or isinstance(node, ast.Import | ast.ImportFrom)
