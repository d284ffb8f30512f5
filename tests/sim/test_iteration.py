"""Loops of the simulation end: their conditions hold no floating-point arithmetic."""

from collections.abc import Iterator
from typing import Any

import jax
import jax.extend.core as jex
import jax.numpy as jnp
import numpy as np
import pytest

from starjax.rcm.trocar import Trocar
from starjax.sim import env as envs
from starjax.sim import iteration
from starjax.types import Command


@pytest.mark.parametrize("most", [0, 1, 3, 50])
def test_halves_each_lane_until_it_is_small_or_the_iterations_end(most):
    start = jnp.array([0.3, 5.0, 1e6])
    halved = jax.vmap(
        lambda x: iteration.improve_while(lambda x: x > 1.0, lambda x: 0.5 * x, x, most)
    )(start)
    counts = np.minimum(np.maximum(np.ceil(np.log2(start)), 0), most)
    np.testing.assert_allclose(halved, start * 0.5**counts, rtol=1e-6)


def test_no_loop_of_a_throw_has_a_condition_of_floats(suture_step):
    conditions = list(_conditions(suture_step.jaxpr))
    assert len(conditions) >= 3  # solver, hole and patch, thread
    for condition in conditions:
        assert not [e for e in condition.eqns if any(_is_float(v) for v in e.invars)], condition


@pytest.fixture(scope="module")
def suture_step() -> Any:
    env = envs.make("suture_throw", observation="state")

    def run(keys: jax.Array) -> Any:
        zeros = jnp.zeros(len(env.p_world_ref))
        params = envs.EnvParams(Trocar(zeros, zeros, zeros))
        state = jax.vmap(env.reset, in_axes=(0, None))(keys, params)
        command = Command(state.pose, state.gripper, state.wrist)
        return jax.vmap(env.step)(state, command)

    return jax.make_jaxpr(run)(jax.random.split(jax.random.key(0), 2))


def _is_float(variable: Any) -> bool:
    return jnp.issubdtype(variable.aval.dtype, jnp.floating)


def _conditions(jaxpr: Any) -> Iterator[Any]:
    """Yields the conditions of all while loops of a program."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "while":
            yield equation.params["cond_jaxpr"].jaxpr
        for inner in jex.jaxprs_in_params(equation.params):
            yield from _conditions(inner)
