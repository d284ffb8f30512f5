"""Tables of the add-ons below `starjax/addons`. Standard library only.

An add-on is a folder there with a module `table`, whose `TABLE` lists its commands and parts. An
absent folder brings nothing; the core imports no other module of an add-on by name.
"""

import functools
import importlib
import pathlib
from collections.abc import Mapping
from typing import Any, NamedTuple


class Subcommand(NamedTuple):
    """A subcommand of `starjax`, also of other packages by an entry point of `starjax.commands`.

    Attributes:
      path: module with `main(argv) -> exit code`, or `module:function`.
      summary: one line of the help.
      extras: keys of `extras.PACKAGES` that it needs.
    """

    path: str
    summary: str
    extras: tuple[str, ...] = ()


class PartKind(NamedTuple):
    """A kind of parts that an add-on brings.

    Attributes:
      registry: `module:object` of its `Registry`.
      check: module with the checks of `starjax check`, as those in `starjax.testing`.
    """

    registry: str
    check: str


class AddOn(NamedTuple):
    """Everything that an add-on brings, by name; paths are `module:object`.

    Attributes:
      summary: one line of the help.
      commands: subcommands.
      parts: kind of part -> name -> path, e.g. of a `Task`.
      kinds: kinds of parts.
      policies: names of trained policies of its tasks, see `policies.packaged`.
      hooks: place in the core -> path of the function that it calls, see `hook`.
    """

    summary: str
    commands: Mapping[str, Subcommand] = {}
    parts: Mapping[str, Mapping[str, str]] = {}
    kinds: Mapping[str, PartKind] = {}
    hooks: Mapping[str, str] = {}
    policies: tuple[str, ...] = ()


@functools.cache
def tables() -> dict[str, AddOn]:
    """Returns the table of each add-on by the name of its folder."""
    folder = pathlib.Path(__file__).parents[1] / "addons"
    names = sorted(file.parent.name for file in folder.glob("*/table.py"))
    return {name: importlib.import_module(f"starjax.addons.{name}.table").TABLE for name in names}


def commands() -> dict[str, Subcommand]:
    """Returns the commands of all add-ons."""
    return {name: row for table in tables().values() for name, row in table.commands.items()}


def parts(kind: str) -> dict[str, str]:
    """Returns name -> `module:object` of all add-ons' parts of a kind."""
    return {
        name: path
        for table in tables().values()
        for name, path in table.parts.get(kind, {}).items()
    }


def policies() -> list[str]:
    """Returns the names of trained policies of add-ons' tasks."""
    return [name for table in tables().values() for name in table.policies]


def kinds() -> dict[str, PartKind]:
    """Returns the kinds of parts that add-ons bring."""
    return {name: kind for table in tables().values() for name, kind in table.kinds.items()}


def hook(place: str) -> Any:
    """Returns the function of an add-on that a place in the core calls, None without the add-on.

    Places: `inspect` (path -> `inspect_command.Found`) and `inspect_page` (path, name of a mapping
    -> motions, anomalies) for datasets that are not starjax's, `list` (() -> tables of
    `starjax list`), `playback` (runs -> `report.page.Playback` or None), `dataset_page` (writes the
    page of `starjax inspect`).
    """
    for table in tables().values():
        if place in table.hooks:
            module, _, name = table.hooks[place].partition(":")
            return getattr(importlib.import_module(module), name)
    return None
