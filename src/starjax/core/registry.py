"""Parts that exist by name, some of them from other packages. Standard library only."""

import functools
import importlib
import importlib.metadata
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping
from importlib.metadata import EntryPoint
from typing import Any, NamedTuple

from starjax.core import errors


def load(path: str) -> Any:
    """Imports the object that `module:object` names."""
    module, _, attribute = path.partition(":")
    return getattr(importlib.import_module(module), attribute)


class Registry(NamedTuple):
    """One kind of part.

    Attributes:
      kind: its name, e.g. `task`; entry points are those of the group with its plural, e.g.
        `starjax.tasks`.
      built_in: name -> `module:object`, or the part itself.
      record: type of a part, as `module:object`; empty for any.
    """

    kind: str
    built_in: Mapping[str, Any]
    record: str = ""

    def names(self) -> list[str]:
        """Returns all names, built-in ones first."""
        return [*self.built_in, *sorted({e.name for e in self._entries()} - {*self.built_in})]

    def get(self, name: str) -> Any:
        """Returns the part of a name.

        Raises:
          errors.UsageError: the name is unknown, several packages provide it, or its package cannot
            be imported or provides another type or name.
        """
        errors.choice(self.kind, name, self.names())
        entries = [entry for entry in self._entries() if entry.name == name]
        owners = ["starjax"] * (name in self.built_in) + list(map(_owner, entries))
        expected = f"one package that provides {name}"
        if len(owners) > 1:
            raise errors.UsageError(self.kind, expected, ", ".join(owners))
        if not entries:
            part = self.built_in[name]
            return load(part) if isinstance(part, str) else part
        where = f"{entries[0].value} of {owners[0]}"
        try:
            part = entries[0].load()
        except Exception as error:  # a module of another package may raise anything
            got = f"{where}: {type(error).__name__}: {error}"
            raise errors.UsageError(self.kind, expected, got) from error
        if self.record and not isinstance(part, load(self.record)):
            expected = f"a {self.record.partition(':')[2]} that is called {name}"
            raise errors.UsageError(self.kind, expected, f"{where}: a {type(part).__name__}")
        if getattr(part, "name", name) != name:
            raise errors.UsageError(
                self.kind, f"one that is called {name}", f"{where}: {part.name}"
            )
        return part

    def path(self, name: str) -> str:
        """Returns the `module:object` that a name stands for; empty if it is unknown or data."""
        if name in self.built_in:
            part = self.built_in[name]
            return part if isinstance(part, str) else ""
        return next((entry.value for entry in self._entries() if entry.name == name), "")

    def _entries(self) -> tuple[EntryPoint, ...]:
        plural = f"{self.kind[:-1]}ies" if self.kind.endswith("y") else f"{self.kind}s"
        return entries(f"starjax.{plural}")


class Rows(Mapping[str, Any]):
    """Parts of a registry as a mapping, which leaves out those that cannot be used.

    Attributes:
      registry: of the parts.
    """

    def __init__(
        self, registry: Registry, complete: Callable[[str, Any], Any] = lambda name, row: row
    ) -> None:
        """Wraps a registry.

        Args:
          complete: (name, part of another package) -> part with defaults that depend on the name.
        """
        self.registry, self._complete = registry, complete

    def __getitem__(self, name: str) -> Any:
        """Returns a part; raises KeyError for an unknown name, UsageError for a broken part."""
        if name not in self.registry.names():
            raise KeyError(name)
        part = self.registry.get(name)
        return part if name in self.registry.built_in else self._complete(name, part)

    def __iter__(self) -> Iterator[str]:
        for name in self.registry.names():
            try:
                self[name]
            except errors.UsageError as error:
                warnings.warn(f"{self.registry.kind} {name} is skipped: {error}", stacklevel=2)
                continue
            yield name

    def __len__(self) -> int:
        return sum(1 for _ in self)


def entries(group: str) -> tuple[EntryPoint, ...]:
    """Returns the entry points of a group; each is listed once however often its path is."""
    return _entries_at(group, tuple(sys.path), importlib.metadata.entry_points)


@functools.lru_cache(maxsize=64)
def _entries_at(
    group: str, paths: tuple[str, ...], find: Callable[..., Any]
) -> tuple[EntryPoint, ...]:
    """Caches `entries`: a look-up reads the metadata of every installed package."""
    found = {(entry.name, entry.value, _owner(entry)): entry for entry in find(group=group)}
    return tuple(found.values())


def _owner(entry: EntryPoint) -> str:
    return entry.dist.name if entry.dist is not None else entry.value.partition(".")[0]
