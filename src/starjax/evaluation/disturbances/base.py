"""Environments in which something is wrong, by as much as a level says, which is data.

Starts, keys and judging are those of the usual environment, and the executed RCM error is measured
against the true trocar. What a disturbance draws depends on the episode's key alone. One program
has all levels of all of them: at level 0 each leaves everything as it was.
"""

import math
import zlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from starjax import errors
from starjax.evaluation.disturbances import DISTURBANCES
from starjax.sim.state import Env, EnvParams, EnvState
from starjax.types import Command, Observation


class Now(NamedTuple):
    """An episode as a disturbance knows it.

    Attributes:
      level: `[]`, how much is wrong.
      key: the episode's own for this disturbance.
      memory: what it carries from step to step.
    """

    level: jax.Array
    key: jax.Array
    memory: Any = ()


class Disturbance(NamedTuple):
    """One kind of trouble. Its functions know of no other; those left out change nothing.

    Attributes:
      what: a sentence.
      unit: of its levels.
      levels: usual ones; 0 is the undisturbed environment.
      most: the highest level that there is.
      tell: (Env, Now, EnvParams) -> EnvParams, before a reset.
      begin: (Env, Now, EnvState) -> EnvState and memory, after it.
      step: (Env, Now, EnvState, Command) -> EnvState and memory.
      observe: (Env, Now, EnvState) -> Observation.
      keeps_states: whether its memory holds states, which others must have changed before.
      moves_cameras: whether it needs an environment whose cameras may move.
      of_images: whether policies that see no images are spared.
      of_demos: whether demonstrations that are recorded with it teach anything of it.
    """

    what: str
    unit: str
    levels: tuple[float, ...]
    most: float = math.inf
    tell: Callable[[Env, Now, EnvParams], EnvParams] = lambda env, now, params: params
    begin: Callable[[Env, Now, EnvState], tuple[EnvState, Any]] = lambda env, now, state: (
        state,
        (),
    )
    step: Callable[[Env, Now, EnvState, Command], tuple[EnvState, Any]] = (
        lambda env, now, state, command: (env.step(state, command), now.memory)
    )
    observe: Callable[[Env, Now, EnvState], Observation] = lambda env, now, state: env.observe(
        state
    )
    keeps_states: bool = False
    moves_cameras: bool = False
    of_images: bool = False
    of_demos: bool = True


def disturbed(env: Env, names: Sequence[str]) -> Env:
    """The environment in which all of these are wrong, at `EnvParams.levels`."""
    kinds: dict[str, Disturbance] = {name: DISTURBANCES.get(name) for name in names}
    for name in sorted(kinds, key=lambda name: kinds[name].keeps_states):
        env = _with(env, name, kinds[name])
    return env


def varied(env: Env, most: Mapping[str, float]) -> Env:
    """The environment in which each of these is wrong at a level that is drawn for every episode,
    evenly from 0 to what is given."""
    wrong = disturbed(env, list(most))

    def reset(key: jax.Array, params: EnvParams) -> EnvState:
        shares = jax.random.uniform(_own(key, "levels"), (len(most),))
        levels = {name: share * high for share, (name, high) in zip(shares, most.items())}
        return wrong.reset(key, params._replace(levels=levels))

    return wrong._replace(reset=reset)


def check_levels(argument: str, name: str, levels: Sequence[float]) -> None:
    """Raises errors.UsageError for a level that the disturbance of this name does not have."""
    kind: Disturbance = DISTURBANCES.get(name)
    for level in levels:
        if level > kind.most:
            raise errors.UsageError(argument, f"at most {kind.most:g} of {name}", level)


def _with(env: Env, name: str, kind: Disturbance) -> Env:
    def reset(key: jax.Array, params: EnvParams) -> EnvState:
        assert params.levels is not None, "a disturbed environment is reset with levels"
        now = Now(jnp.asarray(params.levels[name], jnp.float32), _own(key, name))
        state, memory = kind.begin(env, now, env.reset(key, kind.tell(env, now, params)))
        return _put(state, name, now._replace(memory=memory))

    def step(state: EnvState, command: Command) -> EnvState:
        now, inner = _take(state, name)
        after, memory = kind.step(env, now, inner, command)
        after = _put(after, name, now._replace(memory=memory))
        return jax.tree.map(lambda old, new: jnp.where(state.done, old, new), state, after)

    def observe(state: EnvState) -> Observation:
        return kind.observe(env, *_take(state, name))

    return env._replace(reset=reset, step=step, observe=observe)


# An inner environment meets only what it carries itself, so that its states always look alike.
def _take(state: EnvState, name: str) -> tuple[Now, EnvState]:
    carried = dict(state.wrapper_state)
    return carried.pop(name), state.replace(wrapper_state=carried)


def _put(state: EnvState, name: str, now: Now) -> EnvState:
    return state.replace(wrapper_state={**state.wrapper_state, name: now})


def _own(key: jax.Array, name: str) -> jax.Array:
    return jax.random.fold_in(key, zlib.crc32(name.encode()))
