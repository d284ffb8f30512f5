"""Conditions of the loops of a simulation's programs."""

from collections.abc import Iterator
from typing import Any

import jax
import jax.extend.core as jex
import jax.numpy as jnp

from starjax.core.types import Command
from starjax.rcm.trocar import Trocar
from starjax.sim import env as envs


def conditions(task: str) -> list[Any]:
    """Returns the conditions of all while loops of a task's reset and first step."""
    env = envs.make(task, observation="state")

    def run(keys: jax.Array) -> Any:
        zeros = jnp.zeros(len(env.p_world_ref))
        params = envs.EnvParams(Trocar(zeros, zeros, zeros))
        state = jax.vmap(env.reset, in_axes=(0, None))(keys, params)
        command = Command(state.pose, state.gripper, state.wrist)
        return jax.vmap(env.step)(state, command)

    made = jax.make_jaxpr(run)(jax.random.split(jax.random.key(0), 2))
    return list(_conditions(made.jaxpr))


def with_floats(condition: Any) -> list[Any]:
    """Returns the equations of a condition that read floating-point numbers."""
    return [e for e in condition.eqns if any(_is_float(v) for v in e.invars)]


def _is_float(variable: Any) -> bool:
    return jnp.issubdtype(variable.aval.dtype, jnp.floating)


def _conditions(jaxpr: Any) -> Iterator[Any]:
    for equation in jaxpr.eqns:
        if equation.primitive.name == "while":
            yield equation.params["cond_jaxpr"].jaxpr
        for inner in jex.jaxprs_in_params(equation.params):
            yield from _conditions(inner)
