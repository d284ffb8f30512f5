"""Registries of tasks, arms, tools and workspaces, which packages extend by entry points.

An entry point of the group `starjax.tasks`, `starjax.arms`, `starjax.tools` or
`starjax.workspaces` names a `Task`, an `Arm`, a `Tool` or a `Workspace`; one of `starjax.mounts` a
dict from (arm, tool, workspace) to `Mount`, for arms of other packages; one of `starjax.rescuers` a
`Rescuer`, called as its task's expert is in `rescuer_name`.
"""

import warnings
from typing import TYPE_CHECKING

from starjax.core import extensions, sources
from starjax.core.registry import Registry, entries
from starjax.sim.arms.base import Arm, Mount
from starjax.sim.names import SceneNames

if TYPE_CHECKING:  # importing it takes jax
    from starjax.sim.task import Task

tasks = Registry(
    "task",
    {
        "peg_transfer": "starjax.tasks.peg_transfer.task:TASK",
        "needle_pick": "starjax.tasks.needle_pick.task:TASK",
        "peg_transfer_bimanual": "starjax.tasks.peg_transfer_bimanual.task:TASK",
        "reach": "starjax.tasks.reach.task:TASK",
        "needle_handover": "starjax.tasks.needle_handover.task:TASK",
        "ring_on_wire": "starjax.tasks.ring_on_wire.task:TASK",
        "endoscope_track": "starjax.tasks.endoscope_track.task:TASK",
        **extensions.parts("task"),
    },
    "starjax.sim.task:Task",
)
arms = Registry(
    "arm",
    {
        name: f"starjax.sim.arms.{name}:ARM"
        for name in ("fr5", "ur5e", "panda", "iiwa14", "rcm4", "psm", "psm_si")
    },
    "starjax.sim.arms.base:Arm",
)
tools = Registry(
    "tool",
    {
        name: f"starjax.sim.tools.{name}:TOOL"
        for name in (
            "grasper",
            "grasper_wide",
            "endoscope",
            "endoscope30",
            "needle_driver",
            "prograsp",
        )
    },
    "starjax.sim.tools.base:Tool",
)
workspaces = Registry(
    "workspace",
    {
        name: f"starjax.sim.workspaces:{name.upper()}"
        for name in ("board", "left", "right", "tissue", "wire")
    },
    "starjax.sim.workspaces:Workspace",
)
rescuers = Registry(
    "rescuer",
    extensions.parts("rescuer"),
    "starjax.sim.rescuer:Rescuer",
)


def rescuer_name(task: "Task", expert: str) -> str:
    """Returns the name in `rescuers` of a task's expert, the first one if `expert` is empty."""
    is_first = expert in ("", next(iter(task.experts)))
    return task.name if is_first else f"{task.name}.{expert}"


def parts(names: SceneNames) -> list[sources.Identity]:
    """Returns the identity of each part of a scene."""
    kinds = ((tasks, (names.task,)), (arms, names.arms), (tools, names.tools))
    return [sources.identity(kind, name) for kind, of in kinds for name in of]


def mount(arm: Arm, tool: str, workspace: str) -> Mount | None:
    """Returns the mount of an arm with a tool in a workspace, or None if it is unknown."""
    if (tool, workspace) in arm.mounts:
        return arm.mounts[tool, workspace]
    for entry in entries("starjax.mounts"):
        try:
            record = entry.load().get((arm.name, tool, workspace))
        except Exception as error:  # a broken package leaves those of others
            warnings.warn(f"mounts of {entry.value} are skipped: {error}", stacklevel=2)
            continue
        if record:
            return record
    return None
