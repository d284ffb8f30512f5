"""What exists by name: tasks, arms, tools. Others add theirs by an entry point of their package.

A row of `starjax.tasks`, `starjax.arms` or `starjax.tools` in somebody's `[project.entry-points]`
names an object that is a `Task`, an `Arm` or a `Tool`; a row of `starjax.mounts` a dict from
(arm, tool, workspace) to `Mount`, for arms that are not theirs.
"""

import importlib.metadata

from starjax.registry import Registry
from starjax.sim.arms.base import Arm, Mount

tasks = Registry(
    "task",
    {
        "peg_transfer": "starjax.sim.tasks.peg_transfer.task:TASK",
        "needle_pick": "starjax.sim.tasks.needle_pick.task:TASK",
        "peg_transfer_bimanual": "starjax.sim.tasks.peg_transfer_bimanual.task:TASK",
        "reach": "starjax.sim.tasks.reach.task:TASK",
    },
)
arms = Registry("arm", {"fr5": "starjax.sim.arms.fr5:ARM"})
tools = Registry("tool", {"grasper": "starjax.sim.tools.grasper:TOOL"})


def mount(arm: Arm, tool: str, workspace: str) -> Mount | None:
    """Where an arm with a tool stands in a workspace; None if nobody has said."""
    if (tool, workspace) in arm.mounts:
        return arm.mounts[tool, workspace]
    for entry in importlib.metadata.entry_points(group="starjax.mounts"):
        if found := entry.load().get((arm.name, tool, workspace)):
            return found
    return None
