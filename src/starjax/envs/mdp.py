"""Episodes of a task for reinforcement learning, as pure functions of one episode.

An action is [-1, 1]^D: for each arm its pose in the action space, then its jaws (-1 squeezes, +1 is
open). Bounds of the poses are those of `ranges.actions`. With `absolute` control -1 and 1 are these
bounds; with `relative` control the action is added to the measured pose, 1 being SHARE of half the
range, and the sum keeps to the bounds. It is where the tool is sent; the controller bounds how
fast it moves.

Rewards of a control step:

- `dense`: the task's stage-wise reward, which is 1 where success holds, minus 1. So every step
  before success costs, and a quick success is best. An episode that fails before its time costs
  as much as its remaining steps could, so failing never pays.
- `sparse`: 1 at success, else 0.

An episode terminates at success, when it is lost, or when its simulation has diverged (`invalid`),
and is truncated when time is up. One that is over stays as it is, at reward 0.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp

from starjax import rcm
from starjax.core import errors, extras
from starjax.core.types import Command, Pose
from starjax.envs import ranges, trocar_draws
from starjax.envs.settings import EnvSettings

if TYPE_CHECKING:  # it needs the extra sim, which `make` requires
    from starjax.sim.state import EnvState
    from starjax.sim.task import Task

SHARE = 0.1  # part of half an action's range, in a control step: of a tip 0.15 m/s, as the arms can


class Outcome(NamedTuple):
    """Outcome of a control step: reward float32, terminated and truncated bool."""

    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array


class Episodes(NamedTuple):
    """A task as pure functions.

    Attributes:
      reset: key -> EnvState.
      step: (EnvState, action `[D]`) -> EnvState.
      judge: (EnvState before, EnvState after) -> Outcome.
      observe: "EnvState" -> observation, see `observing`.
      measure: "EnvState" -> name -> number, for `info`.
      camera: "EnvState" -> `[h, w, 3]` uint8 of the first camera.
      decode: (EnvState, action `[D]`) -> Command `[A]`.
      encode: (EnvState, Command `[A]`) -> action `[D]`, not clipped.
      action_size: D.
      max_steps: control steps after which an episode is truncated.
      env: the simulation, `sim.env.Env`.
    """

    reset: Callable[[jax.Array], Any]
    step: Callable[[Any, jax.Array], Any]
    judge: Callable[[Any, Any], Outcome]
    observe: Callable[[Any], Any]
    measure: Callable[[Any], dict[str, jax.Array]]
    camera: Callable[[Any], jax.Array]
    decode: Callable[[Any, jax.Array], Command]
    encode: Callable[[Any, Command], jax.Array]
    action_size: int
    max_steps: int
    env: Any


def make(settings: EnvSettings) -> Episodes:
    """Builds the functions; they are not yet compiled.

    Raises:
      errors.UsageError: a part is unknown or not installed, or a setting is out of range.
    """
    extras.require("starjax.envs", "sim")
    from starjax.envs import observing
    from starjax.sim import env as envs
    from starjax.sim import wrists

    env = envs.make(
        settings.task,
        settings.arms,
        settings.tools,
        observation=settings.observation,
        image_size=settings.image_size,
        cameras=settings.cameras,
    )
    task, space = env.task, _space(settings, env.task)
    bends = space.for_wrist is not None
    low, high = (jnp.asarray(end) for end in ranges.actions(task, space))
    is_relative = settings.control == "relative"
    draw = trocar_draws.make(task, settings.trocar)
    max_steps = round(task.time_limit_s * env.control_hz)
    max_steps = min(max_steps, settings.max_episode_steps or max_steps)

    def reset(key: jax.Array) -> "EnvState":
        key_trocar, key_env = jax.random.split(key)
        return env.reset(key_env, envs.EnvParams(draw(key_trocar)))

    def scaled(state: "EnvState", pose: Pose) -> jax.Array:
        # To [-1, 1]
        return (2.0 * space.encode(pose, state.measured_trocar) - high - low) / (high - low)

    def decode(state: "EnvState", action: jax.Array) -> Command:
        parts = jnp.clip(action, -1.0, 1.0).reshape(task.arms, space.dim + 1)
        target, jaws = parts[:, :-1], parts[:, -1]
        if is_relative:
            # From the measured pose, not the last command: errors do not add up.
            target = jnp.clip(scaled(state, state.pose) + SHARE * target, -1.0, 1.0)
        pose, _ = space.decode(0.5 * (high + low + (high - low) * target), state.measured_trocar)
        command = Command(pose, jaws)
        p_world_trocar = state.measured_trocar.p_world_trocar
        return wrists.through(task, command, p_world_trocar) if bends else command

    def encode(state: "EnvState", command: Command) -> jax.Array:
        target = scaled(state, command.pose)
        if is_relative:
            target = (target - scaled(state, state.pose)) / SHARE
        return jnp.concatenate([target, command.gripper[:, None]], axis=-1).ravel()

    def tool(state: "EnvState") -> jax.Array:
        return jnp.concatenate([scaled(state, state.pose), state.gripper[:, None]], axis=-1).ravel()

    def is_over(state: "EnvState") -> jax.Array:
        return is_terminated(state) | (state.step >= max_steps)

    def step(state: "EnvState", action: jax.Array) -> "EnvState":
        # Stands still once over
        return env.step(state.replace(done=is_over(state)), decode(state, action))

    def judge(before: "EnvState", after: "EnvState") -> Outcome:
        terminated, is_late = is_terminated(after), after.step >= max_steps
        if settings.reward == "sparse":
            reward = after.success.astype(jnp.float32)
        else:
            # A failure costs the rest of the episode: to end early must never pay.
            left = jnp.where(terminated & ~after.success, max_steps - after.step, 0)
            reward = after.reward - 1.0 - left  # below 0 until success: haste pays
        return Outcome(jnp.where(is_over(before), 0.0, reward), terminated, is_late & ~terminated)

    return Episodes(
        reset=reset,
        step=step,
        judge=judge,
        observe=observing.make(env, tool),
        measure=measure,
        camera=lambda state: env.camera(state)[env.names.cameras[0]].rgb,
        decode=decode,
        encode=encode,
        action_size=task.arms * (space.dim + 1),
        max_steps=max_steps,
        env=env,
    )


def _space(settings: EnvSettings, task: "Task") -> rcm.ActionSpace:
    """Returns the action space of the settings for a task with its tools.

    Raises:
      errors.UsageError: it is one for wrists, which the tools lack, or is free as well.
    """
    from starjax.sim import registries, wrists

    needs_wrist = any(wrists.per_arm(registries.tasks.get(settings.task)))
    name = settings.action_space or ("rcm6" if needs_wrist else "rcm4")
    wrist, space = wrists.common(task), rcm.ACTION_SPACES[name]
    if space.for_wrist and space.is_free:
        raise errors.UsageError("action_space", "one on the manifold, for wrists", name)
    if space.for_wrist and wrist is None:
        tools = " ".join(slot.tool for slot in task.slots)
        raise errors.UsageError("tools", f"one kind of wrist, for actions {name}", tools)
    return rcm.action_space(name, wrist)


def is_terminated(state: "EnvState") -> jax.Array:
    """Returns True if an episode ended before its time."""
    return state.success | state.lost | state.invalid


def measure(state: "EnvState") -> dict[str, jax.Array]:
    """Returns the content of `info`; `rcm_error` in m is the arms' largest executed one."""
    return {
        "is_success": state.success,
        "loose": state.loose,
        "lost": state.lost,
        "invalid": state.invalid,
        "collided": state.collided,
        "stage": state.stage,
        "rcm_error": jnp.max(state.rcm_error),
    }
