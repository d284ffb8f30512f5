"""Parts that exist by name, some of them from other packages. Standard library only."""

import importlib
import importlib.metadata
from collections.abc import Mapping
from typing import Any, NamedTuple

from starjax import errors


def load(path: str) -> Any:
    """Imports the object that `module:object` names."""
    module, _, attribute = path.partition(":")
    return getattr(importlib.import_module(module), attribute)


class Registry(NamedTuple):
    """One kind of part.

    Attributes:
      kind: its name, e.g. `task`; entry points are those of the group `starjax.<kind>s`.
      built_in: name -> `module:object`.
    """

    kind: str
    built_in: Mapping[str, str]

    def names(self) -> list[str]:
        """Returns all names, built-in ones first."""
        found = [entry.name for entry in self._entries() if entry.name not in self.built_in]
        return [*self.built_in, *sorted(found)]

    def get(self, name: str) -> Any:
        """Returns the part of a name.

        Raises:
          errors.UsageError: the name is unknown, or its package cannot be imported.
        """
        if name in self.built_in:
            return load(self.built_in[name])
        errors.choice(self.kind, name, self.names())
        entry = next(entry for entry in self._entries() if entry.name == name)
        try:
            return entry.load()
        except (ImportError, AttributeError) as error:
            raise errors.UsageError(
                self.kind, f"a package that provides {name}", f"{entry.value}: {error}"
            ) from error

    def _entries(self) -> list[importlib.metadata.EntryPoint]:
        return list(importlib.metadata.entry_points(group=f"starjax.{self.kind}s"))
