"""Wrists of the tools that a task's slots hold."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from starjax import rcm, registry
from starjax.sim import registries
from starjax.sim.names import SceneNames
from starjax.sim.tasks.base import Task
from starjax.types import Agent, Command, Pose


def per_arm(task: Task) -> tuple[rcm.Wrist | None, ...]:
    """Returns the wrist of each arm's tool, None for a straight one."""
    return tuple(registries.tools.get(slot.tool).wrist for slot in task.slots)


def common(task: Task) -> rcm.Wrist | None:
    """Returns the wrist that all arms have, None if a tool is straight or they differ."""
    first, *rest = per_arm(task)
    return first if all(other == first for other in rest) else None


def holding(task: Task, names: SceneNames) -> Task:
    """Returns the task whose slots name the arms and tools of a scene.

    Its experts bend the wrists of these tools: they are written for those of the task.
    """
    slots = zip(task.slots, names.arms, names.tools, strict=True)
    held = task._replace(
        slots=tuple(slot._replace(arm=arm, tool=tool) for slot, arm, tool in slots)
    )
    if per_arm(held) == per_arm(task):
        return held
    return held._replace(experts={name: _fitted(held, own) for name, own in task.experts.items()})


def _fitted(task: Task, expert: str | Callable[[], Agent]) -> Callable[[], Agent]:
    """Returns an expert whose commands bend the wrists of the task's tools."""

    def make() -> Agent:
        agent = registry.load(expert) if isinstance(expert, str) else expert()

        def fitted(command: Command, state: Any) -> Command:
            p_world_trocar = state.measured_trocar.p_world_trocar
            return command if command.wrist is None else through(task, command, p_world_trocar)

        def act(memory: Any, state: Any) -> tuple[Command, Any, Command]:
            executed, memory, recorded = agent.act(memory, state)
            return fitted(executed, state), memory, fitted(recorded, state)

        return Agent(agent.init, act)

    # The digest of a dataset covers the module of its expert.
    make.__module__ = expert.partition(":")[0] if isinstance(expert, str) else expert.__module__
    return make


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
