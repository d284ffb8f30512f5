"""Wrists of the tools that a task's slots hold."""

import jax
import jax.numpy as jnp

from starjax import rcm
from starjax.sim import registries
from starjax.sim.names import SceneNames
from starjax.sim.tasks.base import Task
from starjax.types import Command


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


def through(task: Task, command: Command, p_world_trocar: jax.Array) -> Command:
    """Returns the command `[A]` with the wrist angles of shafts through their trocars.

    Tips keep their pose within the limits of their wrist, see `rcm.through`; straight tools keep
    theirs. Without a wrist the command is returned unchanged.

    Args:
      task: whose slots name the tools.
      command: `[A]`; its own angles are ignored.
      p_world_trocar: `[A, 3]` m.
    """
    held = per_arm(task)
    if not any(held):
        return command
    poses, angles = [], []
    for arm, wrist in enumerate(held):
        pose = jax.tree.map(lambda leaf, arm=arm: leaf[arm], command.pose)
        if wrist is None:
            found = rcm.WristPose(pose, jnp.zeros(2), jnp.ones((), bool))
        else:
            found = rcm.through(wrist, pose, p_world_trocar[arm])
        poses.append(found.pose)
        angles.append(found.wrist)
    pose = jax.tree.map(lambda *leaves: jnp.stack(leaves), *poses)
    return command._replace(pose=pose, wrist=jnp.stack(angles))
