"""States in which physics is at work: those of the scripted expert's episodes."""

from collections.abc import Callable
from typing import NamedTuple

import _c_mujoco
import jax
import jax.numpy as jnp
import numpy as np

from starjax.core.types import Agent
from starjax.sim import coupling, physics, solver
from starjax.sim import env as envs
from starjax.sim.quiet_mjx import mjx
from starjax.sim.scene import Scene

STEPS = 240  # control steps per episode, 8 s, so most states hold contacts
CPU_LANES = 16  # lanes of a program that has a CPU to itself: enough to share its operations out

Step = Callable[[mjx.Model, mjx.Data], mjx.Data]


class Moment(NamedTuple):
    """All that one physics step depends on.

    Attributes:
      state: positions, velocities, warm start.
      ctrl: `[nu]` the servos' targets.
      p_world_trocar: `[A, 3]` m.
    """

    state: physics.PhysicsState
    ctrl: jax.Array
    p_world_trocar: jax.Array


def at_rest(scene: Scene) -> Moment:
    """Arms at home, the task's objects where an episode begins, trocars at the nominal places."""
    p_world_trocar = jnp.asarray(scene.p_world_ref)
    return Moment(_c_mujoco.at_rest(scene), _c_mujoco.home(scene), p_world_trocar)


def expert(env: envs.Env) -> Agent:
    """The task's first scripted expert."""
    return env.task.expert()


def moments(env: envs.Env, episodes: int) -> Moment:
    """Moments `[N]`, N = 240 x episodes, at the task's trocars in turn; the jaws close."""
    agent, count = expert(env), len(env.task.trocars.radius)
    index = jnp.arange(episodes) % count
    trocars = jax.tree.map(lambda field: jnp.asarray(field)[index], env.task.trocars)

    def episode(inputs):
        key, trocar = inputs
        state = env.reset(key, envs.EnvParams(trocar))

        def act(carry, _):
            state, memory = carry
            command, memory, _ = agent.act(memory, state)
            after = env.step(state, command)
            ctrl = _c_mujoco.servos(env.scene, after.q_target, "closed")
            moment = Moment(state.physics, ctrl, state.trocar.p_world_trocar)
            return (after, memory), moment

        return jax.lax.scan(act, (state, agent.init(key, state)), None, length=STEPS)[1]

    keys = jax.random.split(jax.random.key(11), episodes)
    batch = CPU_LANES if jax.default_backend() == "cpu" else episodes
    found = jax.jit(lambda x: jax.lax.map(episode, x, batch_size=batch))((keys, trocars))
    return jax.tree.map(lambda leaf: np.asarray(leaf).reshape(-1, *leaf.shape[2:]), found)


def starjax_step(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """One step with our contact solver."""
    return solver.step(model, data, applied=data.qfrc_applied)[0]


def stepper(scene: Scene, step: Step) -> Callable[[Moment], Moment]:
    """One `step` of the scene's model, single-sample; targets and trocars stay, jaws are closed."""
    closed = -jnp.ones(len(scene.arms))

    def one(now: Moment) -> Moment:
        state = now.state
        layout = scene.task.sample(scene.bound, jax.random.key(0))  # that of `at_rest`
        forces, memory = coupling.forces(scene, layout, state, closed, now.p_world_trocar)
        data = scene.mjx_data.replace(
            qpos=state.qpos,
            qvel=state.qvel,
            qacc_warmstart=state.qacc_warmstart,
            ctrl=now.ctrl,
            mocap_pos=scene.mjx_data.mocap_pos.at[scene.trocar_mocap].set(now.p_world_trocar),
        )
        if forces is not None:
            data = data.replace(qfrc_applied=forces)
        with jax.default_matmul_precision("highest"):  # as in `sim.env`
            data = step(scene.mjx_model, data)
        after = physics.PhysicsState(data.qpos, data.qvel, data.qacc_warmstart, memory)
        return now._replace(state=after)

    return one
