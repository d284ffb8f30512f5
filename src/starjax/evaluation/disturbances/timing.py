"""Disturbances of time: images and commands come late, or not at all."""

from typing import Any

import jax
import jax.numpy as jnp

from starjax.evaluation.disturbances.base import Disturbance, Now
from starjax.sim.state import Env, EnvState
from starjax.types import Command, Observation

MOST_DELAY = 4  # control steps that are remembered


def _late(now: Now, present: Any, past: Any) -> Any:
    """Value of `level` steps ago; `past` `[MOST_DELAY, ...]`, the latest first."""
    steps = jnp.round(now.level).astype(jnp.int32)
    return jax.tree.map(lambda x, old: jnp.where(steps > 0, old[steps - 1], x), present, past)


def _remembered(present: Any, past: Any) -> Any:
    return jax.tree.map(lambda x, old: jnp.concatenate([x[None], old[:-1]]), present, past)


def _always(present: Any) -> Any:
    return jax.tree.map(lambda x: jnp.stack([x] * MOST_DELAY), present)


def _keep_states(
    env: Env, now: Now, state: EnvState, command: Command
) -> tuple[EnvState, EnvState]:
    return env.step(state, command), _remembered(state, now.memory)


def _see_past(env: Env, now: Now, state: EnvState) -> Observation:
    return env.observe(_late(now, state, now.memory))


def _hold(env: Env, now: Now, state: EnvState) -> tuple[EnvState, Command]:
    return state, _always(Command(state.pose, state.gripper))


def _obey_past(env: Env, now: Now, state: EnvState, command: Command) -> tuple[EnvState, Command]:
    after = env.step(state, _late(now, command, now.memory))
    return after, _remembered(command, now.memory)


def _lose(env: Env, now: Now, state: EnvState, command: Command) -> tuple[EnvState, EnvState]:
    """The state that was last seen is the memory."""
    after = env.step(state, command)
    is_lost = jax.random.bernoulli(jax.random.fold_in(now.key, after.step), now.level)
    return after, jax.tree.map(lambda old, x: jnp.where(is_lost, old, x), now.memory, after)


LATE_VIEW = Disturbance(
    what="what is observed is so many control steps old",
    unit="steps",
    levels=(0.0, 1.0, 2.0, 4.0),
    most=float(MOST_DELAY),
    begin=lambda env, now, state: (state, _always(state)),
    step=_keep_states,
    observe=_see_past,
    keeps_states=True,
)
LATE_COMMANDS = Disturbance(
    what="commands are executed so many control steps late",
    unit="steps",
    levels=(0.0, 1.0, 2.0, 4.0),
    most=float(MOST_DELAY),
    begin=_hold,
    step=_obey_past,
)
DROPPED = Disturbance(
    what="this share of the observations is lost, and the last one that came stands in",
    unit="",
    levels=(0.0, 0.1, 0.3, 0.5),
    most=1.0,
    begin=lambda env, now, state: (state, state),
    step=_lose,
    observe=lambda env, now, state: env.observe(now.memory),
    keeps_states=True,
)
