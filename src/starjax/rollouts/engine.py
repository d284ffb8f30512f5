"""Closed-loop rollouts of a policy as one program: observe, re-plan, execute, until all are done.

A trial is named by (trocar, trial). Its key is `fold_in(fold_in(key(seed), trocar), trial)`: one
half resets the environment, the other is folded with the number of the re-plan for the policy's
noise. So a trial does not know in which batch, on which device or beside whom it runs. Only the
size of the compiled batch may change last bits (of matrix products, and of the simulator when it is
small), so each device always runs equally many trials, some of them idle if there are fewer.
"""

from collections.abc import Callable, Generator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.rcm.trocar import Trocar
from starjax.rollouts import placement
from starjax.sim import env as sim_env
from starjax.types import Command

SEGMENT = 25  # re-plans between two looks at the host


class Settings(NamedTuple):
    """How a policy is run.

    Attributes:
      obs_horizon: O, observations it sees; the first one repeats at the start.
      execute: commands executed before the next plan.
      max_steps: control steps after which a trial has failed.
    """

    obs_horizon: int
    execute: int
    max_steps: int


class Trials(NamedTuple):
    """N trials.

    Attributes:
      trocar: fields `[N]`.
      index: `[N]` int32 of the trocar.
      trial: `[N]` int32.
      wanted: `[N]` bool; the others only fill up the batch.
    """

    trocar: Trocar
    index: Any
    trial: Any
    wanted: Any


class Carry(NamedTuple):
    """N trials under way.

    Attributes:
      env: EnvState `[N]`.
      key: `[N]` keys of the policy's noise.
      command: Command `[N, H]` of the current plan.
      length: `[N]` int32 control steps taken.
      commanded_max: `[N]` m, largest RCM error of an executed command.
      wanted: `[N]` bool.
    """

    env: Any
    key: jax.Array
    command: Command
    length: jax.Array
    commanded_max: jax.Array
    wanted: jax.Array


class Steps(NamedTuple):
    """What is kept of every control step, `[T, N]`; after a trial's end it is meaningless.

    Attributes:
      rcm_error: m, executed. rcm_error_within: m, the largest within the step.
      p_world_tip: `[T, N, 3]` m, measured after the step.
      qpos: `[T, N, Q]` after the step.
    """

    rcm_error: Any
    rcm_error_within: Any
    p_world_tip: Any
    qpos: Any


class Rollouts(NamedTuple):
    """N finished trials, on the host.

    Attributes:
      env: final EnvState `[N]`.
      length: `[N]` control steps taken.
      commanded_max: `[N]` m.
      steps: Steps `[T, N]`, T the longest trial.
    """

    env: Any
    length: np.ndarray
    commanded_max: np.ndarray
    steps: Steps


class Progress(NamedTuple):
    """Of trials under way.

    Attributes:
      passed: share of the time limit.
      rollouts: None until all are over.
    """

    passed: float
    rollouts: Rollouts | None


def make(
    env: Any,
    policy: Any,
    settings: Settings,
    seed: int,
    devices: Sequence[jax.Device] | None = None,
) -> Callable[..., Generator[Progress]]:
    """Builds the programs.

    Args:
      env: `sim.env.Env`.
      policy: `policies.policy.Policy`; only `sample` is used.
      seed: of all trials.
      devices: to split trials over; their number must divide that of the trials.

    Returns:
      run(params, normalizer, trials), which yields Progress now and then, the rollouts at last.
    """
    _check(settings)
    key = jax.random.key(seed)
    start = placement.split(
        _starter(env, policy, settings),
        devices,
        (placement.SHARED, placement.SHARED, placement.SHARED, placement.LANE),
        placement.LANE,
    )
    advance = placement.split(
        _advancer(env, policy, settings),
        devices,
        (placement.SHARED, placement.SHARED, placement.LANE, placement.SHARED),
        (placement.LANE, placement.TIME_LANE),
        donate=(2,),
    )
    plans = -(-settings.max_steps // settings.execute) + 1  # one more: the first executes nothing

    def run(params: Any, normalizer: Any, trials: Trials) -> Generator[Progress]:
        carry = start(key, params, normalizer, trials)
        kept = []
        for first in range(0, plans, SEGMENT):
            carry, steps = advance(params, normalizer, carry, np.int32(first))
            over = np.asarray(carry.env.done | ~carry.wanted)
            kept.append(jax.device_get(steps))
            if over.all():
                break
            yield Progress(min(1.0, (first + SEGMENT) / plans), None)
        length = np.asarray(carry.length)
        # The first row of blocks belongs to plan 0, which has nothing to execute yet.
        joined = jax.tree.map(lambda *parts: np.concatenate(parts)[settings.execute :], *kept)
        steps = jax.tree.map(lambda leaf: leaf[: max(length.max(), 1)], joined)
        commanded_max = np.asarray(carry.commanded_max)
        rollouts = Rollouts(jax.device_get(carry.env), length, commanded_max, Steps(*steps))
        yield Progress(1.0, rollouts)

    return run


def _check(settings: Settings) -> None:
    if min(settings) < 1:
        raise ValueError(f"settings: expected 1 or more everywhere, got {settings}")
    if settings.obs_horizon > settings.execute + 1:
        raise ValueError(
            f"obs_horizon: expected at most execute + 1 = {settings.execute + 1}, "
            f"got {settings.obs_horizon}"
        )


def _starter(env: Any, policy: Any, settings: Settings) -> Callable[..., Carry]:
    def start_one(key: jax.Array, trials: Trials) -> tuple[Any, jax.Array]:
        key = jax.random.fold_in(jax.random.fold_in(key, trials.index), trials.trial)
        key_env, key_policy = jax.random.split(key)
        return env.reset(key_env, sim_env.EnvParams(trials.trocar)), key_policy

    def start(key: jax.Array, params: Any, normalizer: Any, trials: Trials) -> Carry:
        state, key_policy = jax.vmap(start_one, in_axes=(None, 0))(key, trials)
        count = trials.wanted.shape[0]

        def plan(state):
            seen = jax.vmap(env.observe)(state)
            seen = jax.tree.map(lambda x: jnp.stack([x] * settings.obs_horizon, 1), seen)
            return policy.sample(params, normalizer, key_policy, seen, state.trocar)

        # Only the shape of a plan: the first one is made before anything is executed.
        shape = jax.eval_shape(plan, state)
        if (planned := shape.gripper.shape[1]) < settings.execute:
            got = settings.execute
            raise ValueError(f"execute: expected at most the {planned} that are planned, got {got}")
        return Carry(
            env=state,
            key=key_policy,
            command=jax.tree.map(lambda s: jnp.zeros(s.shape, s.dtype), shape),
            length=jnp.zeros(count, jnp.int32),
            commanded_max=jnp.zeros(count),
            wanted=trials.wanted,
        )

    return start


def _advancer(env: Any, policy: Any, settings: Settings) -> Callable[..., tuple[Carry, Steps]]:
    observe = jax.vmap(env.observe)
    step_all = jax.vmap(env.step)
    horizon, execute = settings.obs_horizon, settings.execute

    def step(carry: Carry, i: jax.Array) -> Carry:
        """Executes command i of the plan in every trial that is not over."""
        command = jax.tree.map(lambda x: x[:, i], carry.command)
        port = rcm.trocar_position(carry.env.trocar, env.p_world_ref)
        error = rcm.rcm_error(command.pose, port)
        running = ~carry.env.done
        return carry._replace(
            env=step_all(carry.env, command),
            length=carry.length + running,
            commanded_max=jnp.where(
                running, jnp.maximum(carry.commanded_max, error), carry.commanded_max
            ),
        )

    def execute_and_observe(carry: Carry, count: jax.Array, record: Callable[..., Any], kept: Any):
        """Executes `count` commands; observes before the last O - 1 of them, and after all."""

        def block(state, before):
            first, last = before

            def one(i, state):
                carry, kept = state
                carry = step(carry, i)
                return carry, record(kept, i, carry)

            state = jax.lax.fori_loop(first, last, one, state)
            return state, observe(state[0].env)

        ends = jnp.maximum(count - jnp.arange(horizon - 1, -1, -1, dtype=jnp.int32), 0)
        starts = jnp.concatenate([jnp.zeros(1, jnp.int32), ends[:-1]])
        # A scan, so that the simulator and the renderer are each compiled once.
        state, seen = jax.lax.scan(block, (carry, kept), (starts, ends))
        return state, jax.tree.map(lambda x: jnp.moveaxis(x, 0, 1), seen)

    def advance(params: Any, normalizer: Any, carry: Carry, first: jax.Array):
        """Plans `first` up to `first + SEGMENT`; plan r follows the execution of plan r - 1."""
        kept = jax.tree.map(
            lambda x: jnp.zeros((SEGMENT * execute, *x.shape), x.dtype), _steps(carry)
        )
        stop = jnp.minimum(first + SEGMENT, -(-settings.max_steps // execute) + 1)

        def is_running(loop):
            r, carry, _ = loop
            return (r < stop) & jnp.any(carry.wanted & ~carry.env.done)

        def body(loop):
            r, carry, kept = loop
            taken = (r - 1) * execute
            count = jnp.where(r == 0, 0, jnp.minimum(execute, settings.max_steps - taken))

            def record(kept, i, carry):
                at = (r - first) * execute + i
                return jax.tree.map(lambda all_, one: all_.at[at].set(one), kept, _steps(carry))

            (carry, kept), seen = execute_and_observe(carry, count, record, kept)
            keys = jax.vmap(jax.random.fold_in, in_axes=(0, None))(carry.key, r)
            command = policy.sample(params, normalizer, keys, seen, carry.env.trocar)
            return r + 1, carry._replace(command=command), kept

        _, carry, kept = jax.lax.while_loop(is_running, body, (first, carry, kept))
        return carry, kept

    return advance


def _steps(carry: Carry) -> Steps:
    env = carry.env
    return Steps(env.rcm_error, env.rcm_error_within, env.pose.p, env.sim.qpos)
