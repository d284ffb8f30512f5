"""Wrists of the tools that a task's slots hold."""

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp

from starjax import rcm
from starjax.core import registry
from starjax.core.types import Agent, ArrayTree, Command, Pose
from starjax.sim import registries
from starjax.sim.names import SceneNames
from starjax.sim.state import EnvState
from starjax.sim.task import Task

if TYPE_CHECKING:  # it imports the physics
    from starjax.sim.rescuer import Rescuer

Held = tuple[rcm.Wrist | None, ...]  # the wrist of each arm's tool


def per_arm(task: Task) -> Held:
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


def rescuer(task: Task, name: str) -> "Rescuer":
    """Returns an expert of `registries.rescuers`; it bends the wrists of the task's tools."""
    written = registries.tasks.get(task.name) if task.name in registries.tasks.names() else task
    if per_arm(written) == per_arm(task):
        return registries.rescuers.get(name)
    return _fitted_rescuer(name, per_arm(task))


@functools.lru_cache(maxsize=4)  # programs belong to the functions that they were made of
def _fitted_rescuer(name: str, held: Held) -> "Rescuer":
    found = registries.rescuers.get(name)
    return found._replace(act=_fitted_act(held, found.act))


def _fitted(task: Task, expert: str | Callable[[], Agent]) -> Callable[[], Agent]:
    """Returns an expert whose commands bend the wrists of the task's tools."""

    def make() -> Agent:
        agent = registry.load(expert) if isinstance(expert, str) else expert()
        return Agent(agent.init, _fitted_act(per_arm(task), agent.act))

    # The digest of a dataset covers the module of its expert.
    make.__module__ = expert.partition(":")[0] if isinstance(expert, str) else expert.__module__
    return make


def _fitted_act(held: Held, act: Callable[..., Any]) -> Callable[..., Any]:
    """Returns an expert's `act` whose commands bend the wrists held."""

    def fitted(command: Command, state: EnvState) -> Command:
        p_world_trocar = state.measured_trocar.p_world_trocar
        return command if command.wrist is None else _through(held, command, p_world_trocar)

    def fitted_act(memory: ArrayTree, state: EnvState) -> tuple[Command, Any, Command]:
        executed, memory, recorded = act(memory, state)
        return fitted(executed, state), memory, fitted(recorded, state)

    return fitted_act


def through(task: Task, command: Command, p_world_trocar: jax.Array) -> Command:
    """Returns the command `[..., A]` with the wrist angles of shafts through their trocars.

    Tips keep their pose within the limits of their wrist, see `rcm.through`; straight tools keep
    theirs. Without a wrist the command is returned unchanged.

    Args:
      task: whose slots name the tools.
      command: `[..., A]`; its own angles are ignored.
      p_world_trocar: `[..., A, 3]` m.
    """
    return _through(per_arm(task), command, p_world_trocar)


def with_angles(command: Command, other: Command) -> Command:
    """Returns a command with angles if the other one has some; without, its wrist is straight."""
    if command.wrist is not None or other.wrist is None:
        return command
    return command._replace(wrist=jnp.zeros_like(other.wrist))


def _through(held: Held, command: Command, p_world_trocar: jax.Array) -> Command:
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
