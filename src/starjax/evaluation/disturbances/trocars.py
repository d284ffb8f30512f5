"""Trocars that are not where they are said to be."""

from typing import Any

import jax
import jax.numpy as jnp

from starjax import rcm
from starjax.evaluation.disturbances.base import Disturbance, Now
from starjax.evaluation.disturbances.draws import directions
from starjax.sim import moving_trocars
from starjax.sim.state import Env, EnvParams, EnvState
from starjax.types import Command

BREATH_HZ = 0.25  # breaths a second of a patient at rest
LATE_S = 0.1  # s that a measured trocar is old


def _tell(env: Env, now: Now, params: EnvParams) -> EnvParams:
    p = rcm.trocar_position(params.trocar, env.p_world_ref)
    there = p + 1e-3 * now.level * directions(now.key, p)
    wrong = rcm.trocar_from_position(there, env.p_world_ref)
    return params._replace(
        measured_trocar=_if_wrong(now, wrong, params.measured_trocar or params.trocar)
    )


def _rest(env: Env, now: Now, state: EnvState) -> tuple[EnvState, Any]:
    """Where the trocars are, and are said to be, between breaths."""
    return state, (state.trocar.p_world_trocar, state.measured_trocar.p_world_trocar)


def _rise(env: Env, now: Now, step: jax.Array) -> jax.Array:
    """`[3]` m at a control step, up and down by `level` mm."""
    phase = 2.0 * jnp.pi * BREATH_HZ * jnp.maximum(step, 0) / env.control_hz
    height = 0.5e-3 * now.level * (1.0 - jnp.cos(phase))
    return height * jnp.array([0.0, 0.0, 1.0])


def _breathe(
    env: Env, now: Now, state: EnvState, command: Command, is_told: bool
) -> tuple[EnvState, Any]:
    is_at, said = now.memory
    step, told = state.step + 1, state.measured_trocar
    if is_told:
        late = step - round(LATE_S * env.control_hz)
        told = _if_wrong(now, moving_trocars.frame_at(env, said + _rise(env, now, late)), told)
    there = _if_wrong(now, is_at + _rise(env, now, step), state.trocar.p_world_trocar)
    moved = moving_trocars.move_trocars(env, state, there)
    return env.step(moved.replace(measured_trocar=told), command), now.memory


def _if_wrong(now: Now, wrong: Any, usual: Any) -> Any:
    """What another disturbance has left stays where this one has no level."""
    return jax.tree.map(lambda x, y: jnp.where(now.level > 0, x, y), wrong, usual)


TOLD_WRONGLY = Disturbance(
    what="the trocar is measured wrongly",
    unit="mm",
    levels=(0.0, 1.0, 2.0, 5.0, 10.0),
    tell=_tell,
    of_demos=False,
)
BREATHING = Disturbance(
    what="the trocar moves with the breath, and nobody says so",
    unit="mm",
    levels=(0.0, 2.0, 5.0),
    begin=_rest,
    step=lambda *given: _breathe(*given, is_told=False),
    of_demos=False,
)
BREATHING_LATE = Disturbance(
    what=f"the trocar moves with the breath, and is told {1e3 * LATE_S:g} ms late",
    unit="mm",
    levels=(0.0, 2.0, 5.0),
    begin=_rest,
    step=lambda *given: _breathe(*given, is_told=True),
    of_demos=False,
)
