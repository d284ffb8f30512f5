"""One environment and one compiled step, shared by the tests of the simulation."""

import jax
import jax.numpy as jnp
import pytest

from starjax import rcm
from starjax.sim import env as envs
from starjax.sim import scene

LANES = 12  # one episode a trocar


@pytest.fixture(scope="session")
def sim(environment) -> scene.Scene:
    return environment.scene


@pytest.fixture(scope="session")
def environment() -> envs.Env:
    return envs.make(observation="state")


@pytest.fixture(scope="session")
def agent(environment):
    return environment.task.expert()


@pytest.fixture(scope="session")
def reset(environment):
    """`seed -> EnvState` of the twelve trocars, or of others."""
    compiled = jax.jit(jax.vmap(environment.reset))

    def reset(seed, trocars=rcm.TROCARS, measured_trocar=None):
        given = (
            jax.tree.map(lambda field: jnp.asarray(field)[:, None], x)
            for x in (trocars, measured_trocar)
        )
        return compiled(jax.random.split(jax.random.key(seed), LANES), envs.EnvParams(*given))

    return reset


@pytest.fixture(scope="session")
def step(environment):
    """`(state, command) -> the state after one control step`."""
    return jax.jit(jax.vmap(environment.step))


@pytest.fixture(scope="session")
def drive(environment, agent):
    """`(state, memory) -> the same after one control step under the expert`."""

    def one(state, memory):
        command, memory, _ = agent.act(memory, state)
        return environment.step(state, command), memory

    return jax.jit(jax.vmap(one))


@pytest.fixture(scope="session")
def begin(agent):
    """`(state, seed) -> the expert's memory`."""
    compiled = jax.jit(jax.vmap(agent.init))
    return lambda state, seed: compiled(jax.random.split(jax.random.key(seed), LANES), state)
