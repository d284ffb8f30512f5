"""One environment and one compiled step, shared by the tests of the simulation."""

import jax
import jax.numpy as jnp
import pytest

from starjax import rcm
from starjax.sim import env as envs
from starjax.sim import scene
from starjax.sim.tasks.peg_transfer import expert

LANES = 12  # one episode a trocar


@pytest.fixture(scope="session")
def sim() -> scene.SimModel:
    return scene.load()


@pytest.fixture(scope="session")
def environment() -> envs.Env:
    return envs.make("state")


@pytest.fixture(scope="session")
def reset(environment):
    """`seed -> EnvState` of the twelve trocars, or of others."""
    compiled = jax.jit(jax.vmap(environment.reset))

    def reset(seed, trocars=rcm.TROCARS):
        params = envs.EnvParams(rcm.Trocar(*(jnp.asarray(field) for field in trocars)))
        return compiled(jax.random.split(jax.random.key(seed), LANES), params)

    return reset


@pytest.fixture(scope="session")
def step(environment):
    """`(state, command) -> the state after one control step`."""
    return jax.jit(jax.vmap(environment.step))


@pytest.fixture(scope="session")
def drive(environment):
    """`(state, expert state) -> the same after one control step under the expert`."""

    def one(state, script):
        command, script = expert.act(script, state)
        return environment.step(state, command), script

    return jax.jit(jax.vmap(one))


@pytest.fixture(scope="session")
def begin():
    """`(state, seed) -> expert state`."""
    compiled = jax.jit(jax.vmap(expert.init))
    return lambda state, seed: compiled(jax.random.split(jax.random.key(seed), LANES), state)
