"""Environments with disturbances, whose levels are data.

Starts, keys and success tests are those of the undisturbed environment, and the executed RCM error
refers to the true trocar. Random draws depend only on the episode's key and on the disturbance.
One program runs all levels of all disturbances: at level 0 each changes nothing.
"""

import math
import zlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from starjax.core import errors
from starjax.core.types import Command, Observation, Pose
from starjax.evaluation.disturbances import DISTURBANCES
from starjax.sim import registries
from starjax.sim.names import is_depth
from starjax.sim.state import Env, EnvParams, EnvState


class DisturbanceState(NamedTuple):
    """State of one disturbance in one episode.

    Attributes:
      level: `[]`, strength in the disturbance's unit.
      key: of the episode, for this disturbance alone.
      memory: pytree that it carries from step to step.
    """

    level: jax.Array
    key: jax.Array
    memory: Any = ()


class Disturbance(NamedTuple):
    """One disturbance, as pure functions; each default changes nothing.

    Attributes:
      description: a sentence.
      unit: of the levels.
      levels: those of an evaluation; the first, 0, is undisturbed.
      max_level: highest allowed level.
      stream: text that seeds the draws; empty: its name.
      on_params: (Env, DisturbanceState, EnvParams) -> EnvParams, before a reset.
      on_reset: (Env, DisturbanceState, EnvState) -> EnvState and memory, after a reset.
      on_camera: (DisturbanceState, Pose `[C]` of the cameras) -> Pose, after a reset; None for
        none.
      on_look: DisturbanceState -> `[]` bool, True for images with the look of a body cavity, after
        a reset; None for none.
      on_step: (Env, DisturbanceState, EnvState, Command) -> EnvState and memory.
      on_observe: (Env, DisturbanceState, EnvState) -> Observation.
      on_image: (DisturbanceState, image `[h, w, 3]` in [0, 1], control step) -> image, for every
        image; None for none.
      seen_step: (DisturbanceState, control step) -> the one whose observation is seen then, the
        same or an earlier one; None for the same.
      stores_states: the memory holds states, so other disturbances must act first.
      for_demos: demonstrations that are recorded with it teach a policy to withstand it.
      wrist_only: tools without a wrist never meet it.
      version: raised with a change of its effect at a level.
    """

    description: str
    unit: str
    levels: tuple[float, ...]
    max_level: float = math.inf
    stream: str = ""
    on_params: Callable[[Env, DisturbanceState, EnvParams], EnvParams] = (
        lambda env, disturbance, params: params
    )
    on_reset: Callable[[Env, DisturbanceState, EnvState], tuple[EnvState, Any]] = (
        lambda env, disturbance, state: (state, ())
    )
    on_camera: Callable[[DisturbanceState, Pose], Pose] | None = None
    on_look: Callable[[DisturbanceState], jax.Array] | None = None
    on_step: Callable[[Env, DisturbanceState, EnvState, Command], tuple[EnvState, Any]] = (
        lambda env, disturbance, state, command: (env.step(state, command), disturbance.memory)
    )
    on_observe: Callable[[Env, DisturbanceState, EnvState], Observation] = (
        lambda env, disturbance, state: env.observe(state)
    )
    on_image: Callable[[DisturbanceState, jax.Array, jax.Array], jax.Array] | None = None
    seen_step: Callable[[DisturbanceState, jax.Array], jax.Array] | None = None
    stores_states: bool = False
    for_demos: bool = True
    wrist_only: bool = False
    version: int = 1

    @property
    def image_only(self) -> bool:
        """True if policies without images never meet it."""
        return bool(self.redraws or self.on_image)

    @property
    def redraws(self) -> bool:
        """True if images under it are drawn from another camera's pose or with another look."""
        return bool(self.on_camera or self.on_look)

    @property
    def is_of_motion(self) -> bool:
        """True if it leaves observations as they are, so images remain a function of the state."""
        observes = self.on_observe is not Disturbance._field_defaults["on_observe"]
        return not (observes or self.image_only or self.seen_step)


def check_tools(argument: str, name: str, tools: Sequence[str]) -> None:
    """Raises errors.UsageError for a disturbance of wrists and tools without any."""
    if not suits(DISTURBANCES.get(name), tools):
        raise errors.UsageError(
            argument, f"a tool with a wrist for {name}", " ".join(dict.fromkeys(tools))
        )


def suits(kind: Disturbance, tools: Sequence[str]) -> bool:
    """Returns True if one of the tools can meet the disturbance."""
    if not kind.wrist_only:
        return True
    return any(registries.tools.get(tool).wrist is not None for tool in tools)


def with_disturbances(env: Env, names: Sequence[str]) -> Env:
    """Wraps an environment with these disturbances, at `EnvParams.levels`."""
    kinds: dict[str, Disturbance] = {name: DISTURBANCES.get(name) for name in names}
    for name in sorted(kinds, key=lambda name: kinds[name].stores_states):
        env = _with(env, name, kinds[name])
    return env


def with_random_levels(env: Env, max_levels: Mapping[str, float]) -> Env:
    """Wraps an environment with these disturbances, at levels drawn for every episode.

    A level is uniform from 0 to the maximum.
    """
    disturbed = with_disturbances(env, list(max_levels))

    def reset(key: jax.Array, params: EnvParams) -> EnvState:
        fractions = jax.random.uniform(_fold_in(key, "levels"), (len(max_levels),))
        levels = {
            name: fraction * high for fraction, (name, high) in zip(fractions, max_levels.items())
        }
        return disturbed.reset(key, params._replace(levels=levels))

    return disturbed._replace(reset=reset)


def stream(name: str) -> str:
    """Returns the text that seeds a disturbance's draws, which datasets record as its name."""
    return DISTURBANCES.get(name).stream or name


def start(name: str, level: jax.typing.ArrayLike, key: jax.Array) -> DisturbanceState:
    """Returns a disturbance's state at the start of the episode with this key."""
    return DisturbanceState(jnp.asarray(level, jnp.float32), _fold_in(key, stream(name)))


def change_image(
    kind: Disturbance,
    disturbance: DisturbanceState,
    image: jax.Array,
    step: jax.Array,
    camera: str = "",
) -> jax.Array:
    """Applies `on_image` to an image `[h, w, 3]` uint8 at a control step; depth stays as it is."""
    if kind.on_image is None or is_depth(camera):
        return image
    changed = kind.on_image(disturbance, image.astype(jnp.float32) / 255.0, step)
    return jnp.round(255.0 * jnp.clip(changed, 0.0, 1.0)).astype(jnp.uint8)


def check_levels(argument: str, name: str, levels: Sequence[float]) -> None:
    """Raises errors.UsageError for a level above the disturbance's maximum."""
    kind: Disturbance = DISTURBANCES.get(name)
    for level in levels:
        if level > kind.max_level:
            raise errors.UsageError(argument, f"at most {kind.max_level:g} of {name}", level)


def _with(env: Env, name: str, kind: Disturbance) -> Env:
    def reset(key: jax.Array, params: EnvParams) -> EnvState:
        assert params.levels is not None, "a disturbed environment is reset with levels"
        disturbance = start(name, params.levels[name], key)
        state = env.reset(key, kind.on_params(env, disturbance, params))
        if kind.on_camera is not None:
            state = state.replace(cameras=kind.on_camera(disturbance, state.cameras))
        if kind.on_look is not None:
            state = state.replace(has_look=kind.on_look(disturbance))
        state, memory = kind.on_reset(env, disturbance, state)
        return _put(state, name, disturbance._replace(memory=memory))

    def step(state: EnvState, command: Command) -> EnvState:
        disturbance, inner = _take(state, name)
        after, memory = kind.on_step(env, disturbance, inner, command)
        after = _put(after, name, disturbance._replace(memory=memory))
        return jax.tree.map(lambda old, new: jnp.where(state.done, old, new), state, after)

    def observe(state: EnvState) -> Observation:
        disturbance, inner = _take(state, name)
        observation = kind.on_observe(env, disturbance, inner)
        if kind.on_image is None:
            return observation
        images = {
            camera: change_image(kind, disturbance, image, inner.step, camera)
            for camera, image in (observation.images or {}).items()
        }
        return observation._replace(images=images or None)

    return env._replace(reset=reset, step=step, observe=observe)


# An inner environment meets only its own entries, so its states always have the same structure.
def _take(state: EnvState, name: str) -> tuple[DisturbanceState, EnvState]:
    others = dict(state.wrapper_state)
    return others.pop(name), state.replace(wrapper_state=others)


def _put(state: EnvState, name: str, disturbance: DisturbanceState) -> EnvState:
    return state.replace(wrapper_state={**state.wrapper_state, name: disturbance})


def _fold_in(key: jax.Array, text: str) -> jax.Array:
    return jax.random.fold_in(key, zlib.crc32(text.encode()))
