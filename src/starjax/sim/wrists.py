"""Wrists of the tools that a task's slots hold."""

import jax
import jax.numpy as jnp

from starjax import rcm
from starjax.sim import registries
from starjax.sim.names import SceneNames
from starjax.sim.tasks.base import Task
from starjax.types import Command, Pose


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
    """Returns the command `[..., A]` with the wrist angles of shafts through their trocars.

    Tips keep their pose within the limits of their wrist, see `rcm.through`; straight tools keep
    theirs. Without a wrist the command is returned unchanged.

    Args:
      task: whose slots name the tools.
      command: `[..., A]`; its own angles are ignored.
      p_world_trocar: `[..., A, 3]` m.
    """
    held = per_arm(task)
    if not any(held):
        return command
    (R, p), angles = command.pose, []
    for arm, wrist in enumerate(held):
        found = jnp.zeros((*command.gripper.shape[:-1], 2))
        if wrist is not None:
            pose = Pose(R[..., arm, :, :], p[..., arm, :])
            pose, found, _ = rcm.through(wrist, pose, p_world_trocar[..., arm, :])
            R, p = R.at[..., arm, :, :].set(pose.R), p.at[..., arm, :].set(pose.p)
        angles.append(found)
    return Command(Pose(R, p), command.gripper, jnp.stack(angles, -2))


def shafts(task: Task, command: Command) -> Pose:
    """Returns the commanded shafts `[..., A]`; that of a straight tool is its tip's pose."""
    (R, p), angles = command.pose, command.wrist
    if angles is None:
        return command.pose
    for arm, wrist in enumerate(per_arm(task)):
        if wrist is not None:
            pose = Pose(R[..., arm, :, :], p[..., arm, :])
            pose = rcm.shaft_of(wrist, pose, angles[..., arm, :])
            R, p = R.at[..., arm, :, :].set(pose.R), p.at[..., arm, :].set(pose.p)
    return Pose(R, p)
