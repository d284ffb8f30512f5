"""A closed loop of one episode, compiled: start, step, look. Trocars follow where one drags them.

Undisturbed it is the loop of `rollouts.engine`: a trial's seed, trocar and number give the same
episode here and in an evaluation, but for the last bits of another program.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from starjax.rcm.trocar import Trocar
from starjax.rollouts.agent import BatchAgent, Plan
from starjax.sim import env as sim_env
from starjax.sim import moving_trocars
from starjax.viewer.frame import Frame

# m/s at which a trocar follows its handle: tissue gives way, it does not jump. The controller keeps
# the tool in it.
TROCAR_SPEED = 0.03


class Carry(NamedTuple):
    """An episode under way: EnvState and the agent's memory, `[1]` each, control steps taken, and
    `[1, A, 3]` m, where the trocars were at the last plan."""

    env: Any
    memory: Any
    t: jax.Array
    planned: Any = None


class Simulation(NamedTuple):
    """Somebody in an environment.

    Attributes:
      label: who, for people.
      env: where.
      start: (seed, configuration of the task's trocars, trial) -> (carry, Frame).
      step: (carry, p_world_trocar `[A, 3]` m that is wanted) -> (carry, Frame), both on the host's
        side of the device queue: reading the Frame waits for it.
      look: carry -> name -> `[h, w, 3]` uint8 of each camera.
    """

    label: str
    env: sim_env.Env
    start: Callable[[int, int, int], tuple[Carry, Frame]]
    step: Callable[[Carry, np.ndarray], tuple[Carry, Frame]]
    look: Callable[[Carry], dict[str, jax.Array]]


def make(label: str, env: sim_env.Env, agent: BatchAgent, params: Any = None) -> Simulation:
    """Compiles nothing yet: the first call of each function does."""
    observe = jax.vmap(env.observe)
    execute = agent.about.get("execute", 0)

    @jax.jit
    def start(params: Any, key: jax.Array, trocar: Trocar) -> tuple[Carry, Frame]:
        key_env, key_agent = jax.random.split(key)
        state = env.reset(key_env, sim_env.EnvParams(trocar))
        state = jax.tree.map(lambda x: jnp.asarray(x)[None], state)
        memory = agent.init(params, key_agent[None], state, lambda: observe(state))
        carry = Carry(state, memory, jnp.zeros((), jnp.int32), state.trocar.p_world_trocar)
        return carry, frame(env, carry)

    @jax.jit
    def step(params: Any, carry: Carry, wanted: jax.Array) -> tuple[Carry, Frame]:
        def moved(state: sim_env.EnvState) -> sim_env.EnvState:
            here = state.trocar.p_world_trocar
            there = moving_trocars.toward(here, wanted, TROCAR_SPEED / env.control_hz)
            return moving_trocars.move_trocars(env, state, jnp.where(state.done, here, there))

        before = jax.vmap(moved)(carry.env)
        executed, memory, _ = agent.act(
            params, carry.memory, before, lambda: observe(before), carry.t
        )
        now = before.trocar.p_world_trocar
        planned = jnp.where(carry.t % max(execute, 1) == 0, now, carry.planned)
        executed = moving_trocars.carried(executed, planned, now)
        carry = Carry(jax.vmap(env.step)(before, executed), memory, carry.t + 1, planned)
        return carry, frame(env, carry, execute)

    @jax.jit
    def look(carry: Carry) -> dict[str, jax.Array]:
        state = jax.tree.map(lambda x: x[0], carry.env)
        return {name: seen.rgb for name, seen in env.camera(state).items()}

    trocars = env.task.trocars

    def begin(seed: int, configuration: int, trial: int) -> tuple[Carry, Frame]:
        key = trial_key(seed, configuration, trial)
        chosen = Trocar(*(np.asarray(field[configuration]) for field in trocars))
        carry, first = start(params, key, chosen)
        return carry, jax.device_get(first)

    def advance(carry: Carry, wanted: np.ndarray) -> tuple[Carry, Frame]:
        carry, after = step(params, carry, np.asarray(wanted, np.float32))
        return carry, jax.device_get(after)

    return Simulation(label, env, begin, advance, look)


def trial_key(seed: int, configuration: int, trial: int, stream: int | None = None) -> jax.Array:
    """The key that a trial has in `rollouts.engine`."""
    key = jax.random.key(seed)
    key = key if stream is None else jax.random.fold_in(key, stream)
    return jax.random.fold_in(jax.random.fold_in(key, configuration), trial)


def frame(env: sim_env.Env, carry: Carry, execute: int = 0) -> Frame:
    """A moment as the page shows it."""
    state = jax.tree.map(lambda x: x[0], carry.env)
    plan = jnp.zeros((0, *state.pose.p.shape))
    if execute and isinstance(carry.memory, Plan):
        plan = carry.memory.command.pose.p[0]
        # The next command first; those that are past repeat the last one.
        ahead = (carry.t - 1) % execute + 1 + jnp.arange(len(plan))
        plan = plan[jnp.minimum(ahead, len(plan) - 1)]
    return Frame(
        step=carry.t,
        qpos=state.physics.qpos,
        p_world_trocar=state.trocar.p_world_trocar,
        p_world_tip=state.pose.p,
        rcm_error=state.rcm_error,
        rgb=env.task.colours(env.scene.bound, state.layout, jnp.asarray(env.scene.geom_rgb)),
        plan=plan,
        stage=state.stage,
        reward=state.reward,
        done=state.done,
        success=state.success & ~state.invalid,
        invalid=state.invalid,
        collided=state.collided,
    )
