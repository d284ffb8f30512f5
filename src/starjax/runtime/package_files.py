"""Digests of the files of import packages that may be edited under one version."""

import functools
import hashlib
import importlib.metadata
import importlib.util
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType
from typing import Any

_SUFFIXES = (".py", ".xml", ".toml", ".json")
_started = time.time()  # start of this process, about


class Missing(LookupError):
    """A package whose files are not those of its code."""


def digests(modules: Iterable[str]) -> dict[str, str]:
    """Returns the digests of the packages of modules, and of those whose parts these use.

    Installed packages do not count, as their versions tell them apart, unless they provide parts of
    starjax.

    Raises:
      Missing: one has no files, or was edited since this process imported it.
    """
    waiting, total = {name.partition(".")[0] for name in modules}, {}
    while waiting:
        package = waiting.pop()
        if package not in total and (files := _files(package)):
            total[package] = _digest(files)
            waiting |= _used(package)
    return dict(sorted(total.items()))


@functools.cache
def providers() -> frozenset[str]:
    """Returns the packages that provide parts of starjax by entry points."""
    every = (entry for d in importlib.metadata.distributions() for entry in d.entry_points)
    return frozenset(e.module.partition(".")[0] for e in every if e.group.startswith("starjax."))


@functools.cache
def _files(package: str) -> tuple[Path, ...]:
    """Returns the files of a package; none of an installed one that provides nothing."""
    if package in sys.stdlib_module_names:
        return ()
    try:
        spec = importlib.util.find_spec(package)
    except ValueError:  # from a script, a notebook, or made by hand
        spec = None
    if spec is None or not (places := spec.submodule_search_locations or [spec.origin or ""]):
        raise Missing(f"no files of {package}")
    roots = [Path(place) for place in places]
    own = {"starjax", *providers()}
    if package not in own and any(_is_installed(root) for root in roots):
        return ()
    inside = (path for root in roots for path in [root, *root.rglob("*")])
    return tuple(sorted(path for path in inside if path.suffix in _SUFFIXES))


def _is_installed(root: Path) -> bool:
    """Returns True for a folder or module next to the records of installed packages."""
    return next(root.parent.glob("*.dist-info"), None) is not None


@functools.cache
def _digest(files: tuple[Path, ...]) -> str:
    """Returns the digest of files, read once a process."""
    total = hashlib.sha256()
    for path in files:
        content = path.read_bytes()
        if path.stat().st_ctime > _started:
            raise Missing(f"{path} changed since the start")
        total.update(f"{path.name} {len(content)}\n".encode() + content)
    return total.hexdigest()


def _used(package: str) -> set[str]:
    """Returns the packages of the objects that the loaded modules of a package name."""
    modules = [m for name, m in list(sys.modules.items()) if name.partition(".")[0] == package]
    values = [value for module in modules for value in list(vars(module).values())]
    owners = {_owner(value).partition(".")[0] for value in values}
    return {owner for owner in owners if owner in sys.modules}


def _owner(value: Any) -> str:
    try:
        name = value.__name__ if isinstance(value, ModuleType) else value.__module__
    except Exception:  # a stand-in for a package that is absent raises what it likes
        return ""
    return name if isinstance(name, str) else ""
