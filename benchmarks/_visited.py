"""States in which physics is at work: those of the scripted expert's episodes."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.sim import env as envs
from starjax.sim import physics
from starjax.sim.engine import mjx
from starjax.sim.scene import SimModel
from starjax.sim.tasks.peg_transfer import expert

STEPS = 240  # control steps an episode, 8 s, so most states hold contacts
CPU_LANES = 16  # of a program that has a CPU to itself: enough to share its operations out


def states(env: envs.Env, episodes: int) -> tuple[physics.PhysicsState, np.ndarray]:
    """States `[N]`, N = 240 x episodes, and the servos' targets `[N, 7]` there: the jaws close."""
    index = jnp.arange(episodes)
    trocars = jax.tree.map(lambda field: jnp.asarray(field)[index % 12], rcm.TROCARS)

    def episode(inputs):
        key, trocar = inputs
        state = env.reset(key, envs.EnvParams(trocar))

        def act(carry, _):
            state, script = carry
            command, script = expert.act(script, state)
            after = env.step(state, command)
            return (after, script), (state.sim, jnp.append(after.q_target, physics.JAW_CLOSED))

        return jax.lax.scan(act, (state, expert.init(key, state)), None, length=STEPS)[1]

    keys = jax.random.split(jax.random.key(11), episodes)
    batch = CPU_LANES if jax.default_backend() == "cpu" else episodes
    found = jax.jit(lambda x: jax.lax.map(episode, x, batch_size=batch))((keys, trocars))
    return jax.tree.map(lambda leaf: np.asarray(leaf).reshape(-1, *leaf.shape[2:]), found)


def stepper(sim: SimModel, step: Callable[[mjx.Model, mjx.Data], mjx.Data], model: mjx.Model):
    """`(PhysicsState, ctrl [7]) -> PhysicsState` after one `step` of `model`, single-sample."""

    def one(state: physics.PhysicsState, ctrl: jax.Array) -> physics.PhysicsState:
        data = sim.mjx_data.replace(
            qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.qacc_warmstart, ctrl=ctrl
        )
        with jax.default_matmul_precision("highest"):  # as in `sim.env`
            data = step(model, data)
        return physics.PhysicsState(data.qpos, data.qvel, data.qacc_warmstart)

    return one
