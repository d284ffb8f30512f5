"""Agents of a whole batch: experts and recorded episodes by vmap, policies with plans.

A policy plans anew every `execute` control steps, for all episodes at once, and observes only at
the control steps that its next plan needs; images are drawn for these alone.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from starjax.core import errors
from starjax.core.types import Agent, Command, Observation
from starjax.sim.rollouts import placement
from starjax.sim.state import EnvState

Observe = Callable[[], Observation]


class BatchAgent(NamedTuple):
    """An agent of N episodes at once, as pure functions.

    Attributes:
      init: (params, keys `[N]`, EnvState `[N]`, observe) -> memory, leaves `[N, ...]`.
      act: (params, memory, EnvState `[N]`, observe, t) -> (Command `[N, A]` to execute, memory,
        Command `[N, A]` to record). `observe() -> Observation [N]` looks at the state; `t` int32
        is the number of the control step, the same in all episodes.
      about: JSON values that identify it.
      split: of `params` over devices, `placement.SHARED` or a prefix of their tree.
    """

    init: Callable[..., Any]
    act: Callable[..., tuple[Command, Any, Command]]
    about: dict[str, Any]
    split: Any = placement.SHARED


def from_single(agent: Agent) -> BatchAgent:
    """Makes a batch of one that acts in a single episode, e.g. an expert; `params` are not used."""

    def init(params: Any, keys: jax.Array, state: EnvState, observe: Observe) -> Any:
        return jax.vmap(agent.init)(keys, state)

    def act(params: Any, memory: Any, state: EnvState, observe: Observe, t: jax.Array) -> Any:
        return jax.vmap(agent.act)(memory, state)

    return BatchAgent(init, act, {})


def replay(command: Command) -> Agent:
    """Makes an agent that executes recorded commands `[T, A]`, and holds the last one."""
    last = len(command.gripper) - 1

    def act(memory: tuple[()], state: EnvState) -> tuple[Command, tuple[()], Command]:
        t = jnp.minimum(state.step, last)
        now = jax.tree.map(lambda x: jnp.asarray(x)[t], command)
        return now, memory, now

    return Agent(lambda key, state: (), act)


class Plan(NamedTuple):
    """Memory of a policy in N episodes.

    Attributes:
      key: `[N]` keys of its noise.
      seen: Observation `[N, O]`, the latest looks.
      command: Command `[N, H, A]`, the current plan.
    """

    key: jax.Array
    seen: Observation
    command: Command


@functools.lru_cache(maxsize=4)
def from_policy(sample: Callable[..., Command], obs_horizon: int, execute: int) -> BatchAgent:
    """Makes a batch of a policy, the same one for the same policy; `params` are (weights,
    statistics).

    The noise of plan r of an episode is drawn with `fold_in(key, r)`.

    Args:
      sample: as `Policy.sample`.
      obs_horizon: O, observations it sees; the first one repeats at the start.
      execute: commands executed before the next plan.
    """
    if obs_horizon < 1 or execute < 1:
        raise errors.UsageError("obs_horizon, execute", "1 or more", (obs_horizon, execute))
    if obs_horizon > execute + 1:
        raise errors.UsageError("obs_horizon", f"at most execute + 1 = {execute + 1}", obs_horizon)

    # Traced once for the programs that start and that advance.
    sample = jax.jit(sample, inline=True)

    def init(params: Any, keys: jax.Array, state: EnvState, observe: Observe) -> Plan:
        def first() -> tuple[Observation, Command]:
            seen = _repeated(observe(), obs_horizon)
            return seen, sample(*params, keys, seen, state.measured_trocar)

        # Only the shapes: the first plan is made by `act`.
        seen, command = jax.eval_shape(first)
        if (planned := command.gripper.shape[1]) < execute:
            raise errors.UsageError("execute", f"at most the {planned} that are planned", execute)
        return Plan(keys, *jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), (seen, command)))

    def act(
        params: Any, memory: Plan, state: EnvState, observe: Observe, t: jax.Array
    ) -> tuple[Command, Plan, Command]:
        def look(seen: Observation) -> Observation:
            now = observe()
            later = jax.tree.map(
                lambda old, new: jnp.concatenate([old[:, 1:], new[:, None]], 1), seen, now
            )
            at_start = _repeated(now, obs_horizon)
            return jax.tree.map(lambda x, y: jnp.where(t == 0, x, y), at_start, later)

        def plan(command: Command) -> Command:
            keys = jax.vmap(jax.random.fold_in, in_axes=(0, None))(memory.key, t // execute)
            return sample(*params, keys, seen, state.measured_trocar)

        # A plan starts at t % execute == 0. Observed are that step and the O - 1 steps before it:
        # with O = 2 and execute = 8, t = 0, 7, 8, 15, 16, ...
        to_plan = -t % execute  # control steps until the next plan
        seen = jax.lax.cond(to_plan < obs_horizon, look, lambda seen: seen, memory.seen)
        command = jax.lax.cond(to_plan == 0, plan, lambda command: command, memory.command)
        now = jax.tree.map(lambda x: x[:, t % execute], command)
        return now, Plan(memory.key, seen, command), now

    return BatchAgent(init, act, {"obs_horizon": obs_horizon, "execute": execute})


def _repeated(observation: Observation, count: int) -> Observation:
    return jax.tree.map(lambda x: jnp.stack([x] * count, 1), observation)
