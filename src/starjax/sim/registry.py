"""What exists by name: tasks, arms, tools, workspaces. Others add theirs by entry points.

A row of `starjax.tasks`, `starjax.arms`, `starjax.tools` or `starjax.workspaces` in somebody's
`[project.entry-points]` names an object that is a `Task`, an `Arm`, a `Tool` or a `Workspace`; a
row of `starjax.mounts` a dict from (arm, tool, workspace) to `Mount`, for arms that are not theirs.
"""

import importlib
import importlib.metadata
from collections.abc import Mapping
from typing import Any, NamedTuple

from starjax import errors
from starjax.sim.arms.base import Arm, Mount


class Registry(NamedTuple):
    """One kind of part.

    Attributes:
      kind: what it is called, e.g. `task`; its entry points are those of `starjax.<kind>s`.
      built_in: name -> `module:object`.
    """

    kind: str
    built_in: Mapping[str, str]

    def names(self) -> list[str]:
        """All names, built-in ones first."""
        found = [entry.name for entry in self._entries() if entry.name not in self.built_in]
        return [*self.built_in, *sorted(found)]

    def get(self, name: str) -> Any:
        """The part of that name.

        Raises:
          errors.UsageError: there is none, or its package cannot be imported.
        """
        if name in self.built_in:
            module, _, attribute = self.built_in[name].partition(":")
            return getattr(importlib.import_module(module), attribute)
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


tasks = Registry(
    "task",
    {
        "peg_transfer": "starjax.sim.tasks.peg_transfer.task:TASK",
        "needle_pick": "starjax.sim.tasks.needle_pick.task:TASK",
        "peg_transfer_bimanual": "starjax.sim.tasks.peg_transfer_bimanual.task:TASK",
        "reach": "starjax.sim.tasks.reach.task:TASK",
    },
)
arms = Registry(
    "arm",
    {name: f"starjax.sim.arms.{name}:ARM" for name in ("fr5", "ur5e", "panda", "iiwa14", "rcm4")},
)
tools = Registry("tool", {"grasper": "starjax.sim.tools.grasper:TOOL"})
workspaces = Registry(
    "workspace",
    {name: f"starjax.sim.workspaces:{name.upper()}" for name in ("board", "left", "right")},
)


def mount(arm: Arm, tool: str, workspace: str) -> Mount | None:
    """Where an arm with a tool stands in a workspace; None if nobody has said."""
    if (tool, workspace) in arm.mounts:
        return arm.mounts[tool, workspace]
    for entry in importlib.metadata.entry_points(group="starjax.mounts"):
        if found := entry.load().get((arm.name, tool, workspace)):
            return found
    return None
