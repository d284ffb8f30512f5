"""Programs of the engine: one starts a batch of trials, one runs a segment of control steps.

They are compiled once for the same functions: data, e.g. trials and levels, are arguments.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from starjax.core.types import Command
from starjax.rcm.trocar import Trocar
from starjax.runtime import precompile
from starjax.sim.rollouts import episodes, placement
from starjax.sim.rollouts.agent import BatchAgent
from starjax.sim.state import Env, EnvParams, EnvState


class Trials(NamedTuple):
    """N trials.

    Attributes:
      trocar: fields `[N, A]`.
      index: `[N]` int32 of the trocars' configuration.
      trial: `[N]` int32.
      active: `[N]` bool; the others only fill up the batch.
    """

    trocar: Trocar
    index: Any
    trial: Any
    active: Any


class RolloutState(NamedTuple):
    """N unfinished trials.

    Attributes:
      env: EnvState.
      memory: the agent's.
      length: `[N]` int32, control steps taken.
      active: `[N]` bool, see `Trials`.
    """

    env: EnvState
    memory: Any
    length: jax.Array
    active: jax.Array


def make(
    env: Env,
    agent: BatchAgent,
    max_steps: int,
    record: episodes.Record,
    devices: Sequence[jax.Device] | None,
) -> tuple[Callable[..., RolloutState], Callable[..., Any]]:
    """Builds the program that starts a batch of trials, and the one that runs a segment of it.

    Args:
      env: `sim.env.Env`.
      max_steps: control steps after which a trial is over.
      devices: that lanes are split over; None for one that jax chooses.
    """
    world = _EnvFns(env.reset, env.step, env.observe, env.labels)
    mind = _AgentFns(agent.init, agent.act, agent.split)
    return _programs(world, mind, max_steps, record, None if devices is None else tuple(devices))


class _EnvFns(NamedTuple):
    """The functions of an `Env` that programs call, which are part of the compile cache's key."""

    reset: Callable[..., Any]
    step: Callable[..., Any]
    observe: Callable[..., Any]
    labels: Callable[..., Any]


class _AgentFns(NamedTuple):
    """The same of a `BatchAgent`."""

    init: Callable[..., Any]
    act: Callable[..., Any]
    split: Any


@functools.lru_cache(maxsize=4)
def _programs(
    env: _EnvFns,
    agent: _AgentFns,
    max_steps: int,
    record: episodes.Record,
    devices: Sequence[jax.Device] | None,
) -> tuple[Callable[..., RolloutState], Callable[..., Any]]:
    """Makes the programs from the functions alone: other environments may share them."""
    shared, lane = placement.SHARED, placement.LANE
    start = placement.split(
        _starter(env, agent), devices, (shared, agent.split, lane, shared), lane
    )
    advance = placement.split(
        _advancer(env, agent, max_steps, record),
        devices,
        (agent.split, lane, shared),
        lane,
        donate=(1,),
    )
    return start, advance


def _starter(env: _EnvFns, agent: _AgentFns) -> Callable[..., RolloutState]:
    def start_one(
        key: jax.Array, trials: Trials, levels: Mapping[str, jax.Array] | None
    ) -> tuple[Any, jax.Array]:
        # The trial's own key: its lane and its neighbours have no part in it.
        key = jax.random.fold_in(jax.random.fold_in(key, trials.index), trials.trial)
        key_env, key_agent = jax.random.split(key)
        return env.reset(key_env, EnvParams(trials.trocar, levels=levels)), key_agent

    def start(
        key: jax.Array, params: Any, trials: Trials, levels: dict[str, jax.Array] | None
    ) -> RolloutState:
        state, keys = jax.vmap(start_one, in_axes=(None, 0, None))(key, trials, levels)
        # A function: an agent that reads no observation costs no camera.
        memory = agent.init(params, keys, state, lambda: _of_all(env.observe)(state))
        return RolloutState(state, memory, jnp.zeros(trials.active.shape, jnp.int32), trials.active)

    return start


def _advancer(
    env: _EnvFns, agent: _AgentFns, max_steps: int, record: episodes.Record
) -> Callable[..., Any]:
    observe, step_all = _of_all(env.observe), jax.vmap(env.step)

    def step(
        params: Any, carry: RolloutState, t: jax.Array
    ) -> tuple[RolloutState, dict[str, jax.Array]]:
        before = carry.env
        observed = observe(before) if record.observes else None
        look = (lambda: observe(before)) if observed is None else lambda: observed
        executed, memory, label = agent.act(params, carry.memory, before, look, t)
        after = step_all(before, executed)  # all lanes, those that are over stand still
        made = episodes.Step(observed, label, executed, before, after, memory)
        fields = record.fields(made)
        # ~done counts the step that ends an episode, and none after it.
        return RolloutState(after, memory, carry.length + ~before.done, carry.active), fields

    def advance(params: Any, carry: RolloutState, first: jax.Array) -> Any:
        """Runs control steps `first` to `first + record.frames`, fewer if all episodes end.

        Returns the carry, records `[N, record.frames]`, and the status `[N]`.
        """
        shapes = jax.eval_shape(lambda carry: _fields(env, record, carry.env, carry.memory), carry)
        blank = jax.tree.map(
            lambda s: jnp.zeros((s.shape[0], record.frames, *s.shape[1:]), s.dtype), shapes
        )
        last = jnp.minimum(first + record.frames, max_steps)

        def is_running(loop):
            t, carry, _ = loop
            # Idle lanes do not keep it running
            return (t < last) & jnp.any(carry.active & ~carry.env.done)

        def body(loop):
            t, carry, records = loop
            carry, fields = step(params, carry, t)
            # In place: not `.at[:, i].set`, a scatter, which may move the whole of the images.
            put = functools.partial(jax.lax.dynamic_update_index_in_dim, index=t - first, axis=1)
            return t + 1, carry, jax.tree.map(put, records, fields)

        _, carry, records = jax.lax.while_loop(is_running, body, (first, carry, blank))
        return carry, records, status(env, carry)

    return advance


@functools.lru_cache(maxsize=4)
def _of_all(observe: Callable[..., Any]) -> Callable[..., Any]:
    """Returns the observation of N states, traced once for all programs, for shapes too."""
    return jax.jit(jax.vmap(observe), inline=True)


def _fields(
    env: Env | _EnvFns, record: episodes.Record, state: EnvState, memory: Any = None
) -> dict[str, jax.Array]:
    """Records N episodes that stand still, for the shapes."""
    observed = _of_all(env.observe)(state) if record.observes else None
    command = Command(state.pose, state.gripper)
    return record.fields(episodes.Step(observed, command, command, state, state, memory))


def frame(env: Env, record: episodes.Record) -> dict[str, jax.ShapeDtypeStruct]:
    """Returns the shapes of one recorded control step, without computing anything."""
    functions = _EnvFns(env.reset, env.step, env.observe, env.labels)
    return dict(_frame(functions, len(env.p_world_ref), record))


@functools.lru_cache(maxsize=4)  # a trace takes seconds, and a dataset is described several times
def _frame(env: _EnvFns, arms: int, record: episodes.Record) -> dict[str, jax.ShapeDtypeStruct]:
    def one(key: jax.Array) -> dict[str, jax.Array]:
        zeros = jnp.zeros(arms)
        state = env.reset(key, EnvParams(Trocar(zeros, zeros, zeros)))
        batch = jax.tree.map(lambda x: jnp.asarray(x)[None], state)
        return jax.tree.map(lambda x: x[0], _fields(env, record, batch))

    return precompile.Program(one).shapes(jax.random.key(0))


def status(env: Env | _EnvFns, carry: RolloutState) -> dict[str, Any]:
    """Returns the status of N episodes: `over`, `length`, flags, `stage` and `labels`, `[N]`."""
    state = carry.env
    found = {
        "over": state.done,
        "length": carry.length,
        "success": state.success & ~state.invalid,
        "loose": state.loose & ~state.invalid,
        "invalid": state.invalid,
        "collided": state.collided,
        "lost": state.lost,
        "stage": state.stage,
        "labels": jax.vmap(env.labels)(state),
    }
    # Copied, as the next segment is given the carry's memory before the host has read this.
    return jax.tree.map(jnp.copy, found)
