"""Episodes of a policy with noise on its plans, recorded as policy gradients need them.

The noise of a decision moves its whole plan. The controller filters noise that differs from
command to command: it explores little, and its density has E times as many dimensions.

All decisions of a batch stay on the device; images become features of the frozen encoder.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from starjax import rcm
from starjax.addons.finetune import critic
from starjax.core.types import ArrayTree, Observation
from starjax.policies.base import Policy
from starjax.rcm.trocar import Trocar
from starjax.runtime import precompile
from starjax.sim import env as sim_env
from starjax.sim import wrists
from starjax.sim.state import Env, EnvState

See = Callable[[Any, jax.Array], jax.Array]


class ExploreSettings(NamedTuple):
    """Static settings of episodes.

    Attributes:
      obs_horizon: O.
      execute: E, commands per decision.
      decisions: R, of an episode.
    """

    obs_horizon: int
    execute: int
    decisions: int


class Starts(NamedTuple):
    """N trials: fields `[N, A]` of the trocars, their index `[N]`, the trial's number `[N]`."""

    trocar: Trocar
    index: Any
    trial: Any


class Experience(NamedTuple):
    """Decisions of N episodes.

    Attributes:
      observation: `[N, R, O, ...]`, with features instead of images.
      key: `[N, R]` typed keys of the learner's own noise.
      action: `[N, R, E, D]` normalised ones with noise, those that are executed.
      seen: `[N, R, K]`, see `critic.inputs`.
      alive: `[N, R]` bool, False after the end.
      reward: `[N, R]`, 1 for the decision that succeeded.
      trocar: measured frames `[N]`.
      success: `[N]` bool, strict.
      rcm_commanded, rcm_executed: m `[]`, largest errors of all steps.
    """

    observation: Observation
    key: jax.Array
    action: jax.Array
    seen: jax.Array
    alive: jax.Array
    reward: jax.Array
    trocar: Any
    success: jax.Array
    rcm_commanded: jax.Array
    rcm_executed: jax.Array


def make(
    env: Env, policy: Policy, see: See | None, cameras: tuple[str, ...], settings: ExploreSettings
) -> precompile.Program:
    """Builds the program of a batch of episodes.

    Args:
      env: `sim.env.Env`.
      policy: with `generate` and `execute`.
      see: (vision's parameters, images `[B, h, w, 3]`) -> features `[B, d_v]`; None without images.
      cameras: that the policy reads, in its order.
      settings: of the episodes.

    Returns:
      play(params, vision, stats, starts, key_reset, key, noise) -> Experience. A start is a
      function of `key_reset`, its index and its number, and displacements are one of `key`.
      `noise` `[N]` is their standard deviation in normalised actions, 0 for unchanged plans.
    """
    generate, execute = policy.generate, policy.execute
    assert generate is not None and execute is not None
    horizon, commands, decisions = settings
    observe, step, inputs = jax.vmap(env.observe), jax.vmap(env.step), critic.inputs(env)

    def start(key: jax.Array, starts: Starts) -> Any:
        key = jax.random.fold_in(jax.random.fold_in(key, starts.index), starts.trial)
        return env.reset(key, sim_env.EnvParams(starts.trocar))

    def look(vision: ArrayTree, past: ArrayTree) -> Observation:
        """Observes states `[O, N]`; returns leaves `[N, O, ...]`."""

        def one(state: EnvState) -> Observation:
            found = observe(state)
            if see is None:
                return found
            images = found.images or {}
            visual = jnp.concatenate([see(vision, images[name]) for name in cameras], axis=-1)
            return found._replace(images=None, features=visual)

        return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, 1), jax.lax.map(one, past))

    def play(params, vision, stats, starts, key_reset, key, noise):
        state = jax.vmap(start, (None, 0))(key_reset, starts)
        trocar = state.measured_trocar
        keys = jax.vmap(jax.random.split, (0, None))(
            jax.random.split(key, len(starts.trial)), decisions
        )

        def decide(r, past):
            state = jax.tree.map(lambda leaf: leaf[-1], past)
            observation = look(vision, past)
            key_own, key_noise = jnp.moveaxis(jax.vmap(jax.random.split)(keys[:, r]), 1, 0)
            with jax.default_matmul_precision("highest"):
                action = generate(params, stats, key_own, observation, trocar)
            size = action.shape[-1]
            moved = jax.vmap(lambda k: jax.random.normal(k, (1, size)))(key_noise)
            action = action + noise[:, None, None] * moved
            plan = execute(params, stats, action, observation, trocar)

            def act(carry, command):
                past, commanded, executed = carry
                before = jax.tree.map(lambda leaf: leaf[-1], past)
                after = step(before, command)
                past = jax.tree.map(
                    lambda old, new: jnp.concatenate([old[1:], new[None]]), past, after
                )
                shaft = wrists.shafts(env.task, command)
                error = rcm.rcm_error(shaft, after.trocar.p_world_trocar)
                alive = ~before.done[:, None]
                commanded = jnp.maximum(commanded, jnp.max(error, where=alive, initial=0.0))
                executed = jnp.maximum(
                    executed, jnp.max(after.rcm_error_within, where=alive, initial=0.0)
                )
                return (past, commanded, executed), None

            first = jax.tree.map(lambda leaf: jnp.moveaxis(leaf[:, :commands], 1, 0), plan)
            (past, *errors), _ = jax.lax.scan(act, (past, 0.0, 0.0), first)
            won = jax.tree.map(lambda leaf: leaf[-1], past).success & ~state.success
            record = {
                "observation": observation,
                "action": action[:, :commands],
                "seen": inputs(state),
                "alive": ~state.done,
                "reward": (won & ~state.done).astype(jnp.float32),
            }
            return past, record, jnp.stack(errors)

        past = jax.tree.map(lambda leaf: jnp.stack([leaf] * horizon), state)
        shapes = jax.eval_shape(decide, 0, past)[1]
        blank = jax.tree.map(
            lambda s: jnp.zeros((s.shape[0], decisions, *s.shape[1:]), s.dtype), shapes
        )

        def is_running(loop):
            r, past, *_ = loop
            return (r < decisions) & ~jnp.all(past.done[-1])

        def body(loop):
            r, past, records, errors = loop
            past, record, here = decide(r, past)
            put = functools.partial(jax.lax.dynamic_update_index_in_dim, index=r, axis=1)
            return r + 1, past, jax.tree.map(put, records, record), jnp.maximum(errors, here)

        loop = jax.lax.while_loop(is_running, body, (0, past, blank, jnp.zeros(2)))
        _, past, records, errors = loop
        own = jax.vmap(jax.vmap(lambda k: jax.random.split(k)[0]))(keys)
        success = past.success[-1] & ~past.invalid[-1]
        return Experience(
            **records, key=own, trocar=trocar, success=success,
            rcm_commanded=errors[0], rcm_executed=errors[1],
        )  # fmt: skip

    return precompile.Program(play)
