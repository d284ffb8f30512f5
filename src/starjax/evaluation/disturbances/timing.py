"""Disturbances of time: observations and commands are delayed or lost."""

import jax
import jax.numpy as jnp

from starjax.core.types import Command, Observation, Tree
from starjax.evaluation.disturbances.base import Disturbance, DisturbanceState
from starjax.sim.state import Env, EnvState

MAX_DELAY = 4  # control steps in memory
MAX_LOST = 63  # successive lost observations in training; in episodes there may be more


def _delayed(disturbance: DisturbanceState, present: Tree) -> Tree:
    """Returns the value of `level` steps ago; memory `[MAX_DELAY, ...]` has the latest first."""
    steps = jnp.round(disturbance.level).astype(jnp.int32)
    return jax.tree.map(
        lambda x, past: jnp.where(steps > 0, past[steps - 1], x), present, disturbance.memory
    )


def _pushed(present: Tree, memory: Tree) -> Tree:
    return jax.tree.map(lambda x, past: jnp.concatenate([x[None], past[:-1]]), present, memory)


def _repeated(present: Tree) -> Tree:
    return jax.tree.map(lambda x: jnp.stack([x] * MAX_DELAY), present)


def _remember_state(
    env: Env, disturbance: DisturbanceState, state: EnvState, command: Command
) -> tuple[EnvState, EnvState]:
    return env.step(state, command), _pushed(state, disturbance.memory)


def _observe_past(env: Env, disturbance: DisturbanceState, state: EnvState) -> Observation:
    return env.observe(_delayed(disturbance, state))


def _hold_pose(
    env: Env, disturbance: DisturbanceState, state: EnvState
) -> tuple[EnvState, Command]:
    return state, _repeated(Command(state.pose, state.gripper, state.wrist))


def _execute_past(
    env: Env, disturbance: DisturbanceState, state: EnvState, command: Command
) -> tuple[EnvState, Command]:
    if command.wrist is None and state.wrist is not None:  # a straight wrist
        command = command._replace(wrist=jnp.zeros_like(state.wrist))
    after = env.step(state, _delayed(disturbance, command))
    return after, _pushed(command, disturbance.memory)


def _is_lost(disturbance: DisturbanceState, step: jax.Array) -> jax.Array:
    return jax.random.bernoulli(jax.random.fold_in(disturbance.key, step), disturbance.level)


def _drop(
    env: Env, disturbance: DisturbanceState, state: EnvState, command: Command
) -> tuple[EnvState, EnvState]:
    """Advances one step; the memory is the last state that was observed."""
    after = env.step(state, command)
    is_lost = _is_lost(disturbance, after.step)
    return after, jax.tree.map(lambda old, x: jnp.where(is_lost, old, x), disturbance.memory, after)


def _last_received(disturbance: DisturbanceState, step: jax.Array) -> jax.Array:
    """Returns the last step that was not lost, at most `MAX_LOST` steps ago.

    No loop: its condition would make a GPU wait for the host.
    """
    past = step - jnp.arange(MAX_LOST + 1)
    is_lost = jax.vmap(lambda step: _is_lost(disturbance, step))(past)
    # The first observation is never lost.
    is_received = (~is_lost | (past <= 0)).at[-1].set(True)
    return jnp.maximum(past[jnp.argmax(is_received)], 0)


OBSERVATION_DELAY = Disturbance(
    description="observations are this many control steps old",
    unit="steps",
    levels=(0.0, 1.0, 2.0, 4.0),
    max_level=float(MAX_DELAY),
    stream="late_view",
    on_reset=lambda env, disturbance, state: (state, _repeated(state)),
    on_step=_remember_state,
    on_observe=_observe_past,
    seen_step=lambda disturbance, step: jnp.maximum(
        step - jnp.round(disturbance.level).astype(jnp.int32), 0
    ),
    stores_states=True,
)
ACTION_DELAY = Disturbance(
    description="commands are executed this many control steps late",
    unit="steps",
    levels=(0.0, 1.0, 2.0, 4.0),
    max_level=float(MAX_DELAY),
    stream="late_commands",
    on_reset=_hold_pose,
    on_step=_execute_past,
)
OBSERVATION_DROPOUT = Disturbance(
    description="this fraction of the observations is lost; the previous one is repeated",
    unit="",
    levels=(0.0, 0.1, 0.3, 0.5),
    max_level=1.0,
    stream="dropped",
    on_reset=lambda env, disturbance, state: (state, state),
    on_step=_drop,
    on_observe=lambda env, disturbance, state: env.observe(disturbance.memory),
    seen_step=_last_received,
    stores_states=True,
)
