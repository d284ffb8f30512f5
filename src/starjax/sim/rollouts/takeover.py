"""An agent whose expert takes over from its policy, in the same episode, once there is trouble.

The signals and the expert see the simulator's state; the policy sees its observation. The expert
keeps control to the end: its demonstration begins at a state that the policy led to.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from starjax.core.types import Tree
from starjax.sim import wrists
from starjax.sim.rescuer import Rescuer
from starjax.sim.rollouts import episodes, placement, progress
from starjax.sim.rollouts.agent import BatchAgent, Observe
from starjax.sim.state import EnvState

POLICY, EXPERT, PERSON = range(3)  # values of the field `actor`, see `episodes.FIELDS`
ACTOR, CAUSE = "actor", "cause"  # recorded fields, `[N]` uint8
INTERVENTION = "intervention"  # source of records of an expert or a person who took over
PROGRESSED = "progressed"  # the same, int32: step of the latest progress


class TakeoverLimits(NamedTuple):
    """Control steps; data, not part of a program.

    Attributes:
      clock: `[N]` int32, step from which the expert takes over, unless the conditions of strict
        success hold: they end the episode soon, and its lesson would be to stay.
      stalled: int32, steps without progress.
    """

    clock: Any
    stalled: Any


class Takeover(NamedTuple):
    """Memory in N episodes.

    Attributes:
      policy: the policy's.
      key: `[N]` keys of the expert.
      script: the expert's, meaningless before it takes over.
      progress: of the episodes.
      cause: `[N]` int32, see `progress.CAUSES`; 0 while the policy acts.
    """

    policy: Any
    key: jax.Array
    script: Any
    progress: progress.BestReward
    cause: jax.Array


def from_policy(policy: BatchAgent, rescuer: Rescuer) -> BatchAgent:
    """Makes the agent; its parameters are (those of the policy, TakeoverLimits)."""
    functions = _functions(policy.init, policy.act, rescuer)
    split = (policy.split, TakeoverLimits(placement.LANE, placement.SHARED))
    return BatchAgent(*functions, {"policy": policy.about}, split)


@functools.lru_cache(maxsize=4)  # programs belong to the functions that they were made of
def _functions(
    begin: Callable[..., Any], decide: Callable[..., Any], rescuer: Rescuer
) -> tuple[Callable[..., Any], Callable[..., Any]]:
    def init(params: Any, keys: jax.Array, state: EnvState, observe: Observe) -> Takeover:
        key_policy, key = jnp.moveaxis(jax.vmap(jax.random.split)(keys), 1, 0)
        begun = jax.vmap(lambda _: progress.begin())(key)
        none = jnp.zeros(key.shape, jnp.int32)
        script = jax.vmap(rescuer.resume)(key, state)
        memory = begin(params[0], key_policy, state, observe)
        return Takeover(memory, key, script, begun, none)

    def act(
        params: Any, memory: Takeover, state: EnvState, observe: Observe, t: jax.Array
    ) -> tuple[Any, Takeover, Any]:
        limits: TakeoverLimits = params[1]
        update = functools.partial(progress.update, stalled_steps=limits.stalled)
        now, stalled = jax.vmap(update)(memory.progress, state)
        nearly_lost = jax.vmap(rescuer.nearly_lost)(state)
        # Not while the success settles: a demonstration from there would teach to stay.
        late = (state.step >= limits.clock) & (state.settled == 0)
        number = progress.cause(stalled, late, nearly_lost)
        number = jnp.where(memory.cause > 0, memory.cause, number)  # the first cause stays
        # The expert begins at this very state.
        begins = (number > 0) & (memory.cause == 0)
        # Computed in every step: under vmap both sides of a condition run anyway.
        fresh = jax.vmap(rescuer.resume)(memory.key, state)
        script = _where(begins, fresh, memory.script)
        *theirs, script_after = _last(jax.vmap(rescuer.act)(script, state))
        *ours, policy_after = _last(decide(params[0], memory.policy, state, observe, t))
        # Either may leave the wrists straight, by commands without angles.
        theirs, ours = (
            [wrists.with_angles(command, other) for command, other in zip(one, another)]
            for one, another in ((theirs, ours), (ours, theirs))
        )
        executed, label = _where(number > 0, theirs, ours)
        script = _where(number > 0, script_after, script)
        return executed, Takeover(policy_after, memory.key, script, now, number), label

    return init, act


def _last(acted: tuple[Any, Any, Any]) -> tuple[Any, Any, Any]:
    executed, memory, label = acted
    return executed, label, memory


def _where(which: jax.Array, a: Tree, b: Tree) -> Tree:
    """Returns the leaves `[N, ...]` of `a` in the episodes `which` `[N]`, else those of `b`."""

    def choose(x: jax.Array, y: jax.Array) -> jax.Array:
        return jnp.where(which.reshape(-1, *[1] * (x.ndim - 1)), x, y)

    return jax.tree.map(choose, a, b)


def _fields(step: episodes.Step) -> dict[str, jax.Array]:
    number = step.memory.cause.astype(jnp.uint8)
    actor = jnp.where(number > 0, EXPERT, POLICY).astype(jnp.uint8)
    numbers = {ACTOR: actor, CAUSE: number, PROGRESSED: step.memory.progress.step}
    return {**episodes.without_images(step), **numbers}


# By the environment's observation.
RECORDS = {
    "image": episodes.SCORE._replace(fields=_fields),
    "state": episodes.SCORE._replace(fields=_fields, observes=True),
}


def with_actor(description: dict[str, Any], source: str, policy: str) -> dict[str, Any]:
    """Returns the description of a dataset whose commands come from several agents.

    Args:
      description: see `schema.describe`.
      source: of the episodes' records.
      policy: digest of the policy.
    """
    actor = {"shape": [], "dtype": "|u1", "what": episodes.what(ACTOR)}
    features = {**description["features"], ACTOR: actor}
    return {**description, "features": features, "learned": source, "policy": policy}
