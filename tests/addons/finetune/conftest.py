"""Starts of peg transfer, shared by the tests of experts that take over."""

import jax
import jax.numpy as jnp
import pytest

from starjax import rcm
from starjax.sim import env as envs


@pytest.fixture(scope="session")
def reset():
    """`seed -> EnvState` of the twelve trocars."""
    environment = envs.make(observation="state")
    trocars = jax.tree.map(lambda x: jnp.asarray(x)[:, None], rcm.TROCARS)
    compiled = jax.jit(jax.vmap(environment.reset))
    return lambda seed: compiled(
        jax.random.split(jax.random.key(seed), 12), envs.EnvParams(trocars, None)
    )
