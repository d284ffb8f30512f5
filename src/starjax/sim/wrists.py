"""Wrists of the tools that a task's slots hold."""

from starjax import rcm
from starjax.sim import registries
from starjax.sim.names import SceneNames
from starjax.sim.tasks.base import Task


def per_arm(task: Task) -> tuple[rcm.Wrist | None, ...]:
    """Returns the wrist of each arm's tool, None for a straight one."""
    return tuple(registries.tools.get(slot.tool).wrist for slot in task.slots)


def common(task: Task) -> rcm.Wrist | None:
    """Returns the wrist that all arms have, None if a tool is straight or they differ."""
    first, *rest = per_arm(task)
    return first if all(other == first for other in rest) else None


def holding(task: Task, names: SceneNames) -> Task:
    """Returns the task whose slots name the arms and tools of a scene."""
    slots = zip(task.slots, names.arms, names.tools, strict=True)
    return task._replace(
        slots=tuple(slot._replace(arm=arm, tool=tool) for slot, arm, tool in slots)
    )
