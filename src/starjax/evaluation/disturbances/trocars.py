"""Disturbances of trocars: the measured one differs from the true one, or the true one moves."""

from typing import Any

import jax
import jax.numpy as jnp

from starjax import rcm
from starjax.core.types import Command, Tree
from starjax.evaluation.disturbances.base import Disturbance, DisturbanceState
from starjax.evaluation.disturbances.draws import directions
from starjax.sim import moving_trocars
from starjax.sim.state import Env, EnvParams, EnvState

BREATH_HZ = 0.25  # rate of a patient at rest
LATENCY_S = 0.1  # s, age of a tracked trocar's measurement


def _offset(env: Env, disturbance: DisturbanceState, params: EnvParams) -> EnvParams:
    p = rcm.trocar_position(params.trocar, env.p_world_ref)
    measured = p + 1e-3 * disturbance.level * directions(disturbance.key, p)
    trocar = rcm.trocar_from_position(measured, env.p_world_ref)
    default = params.measured_trocar or params.trocar
    return params._replace(measured_trocar=_if_active(disturbance, trocar, default))


def _rest(env: Env, disturbance: DisturbanceState, state: EnvState) -> tuple[EnvState, Any]:
    """Stores the true and measured rest positions of the trocars."""
    return state, (state.trocar.p_world_trocar, state.measured_trocar.p_world_trocar)


def _rise(env: Env, disturbance: DisturbanceState, step: jax.Array) -> jax.Array:
    """Returns the trocars' displacement `[3]` m at a control step, up to `level` mm upwards."""
    phase = 2.0 * jnp.pi * BREATH_HZ * jnp.maximum(step, 0) / env.control_hz
    height = 0.5e-3 * disturbance.level * (1.0 - jnp.cos(phase))
    return height * jnp.array([0.0, 0.0, 1.0])


def _breathe(
    env: Env,
    disturbance: DisturbanceState,
    state: EnvState,
    command: Command,
    is_tracked: bool,
) -> tuple[EnvState, Any]:
    true_rest, measured_rest = disturbance.memory
    step, measured = state.step + 1, state.measured_trocar
    if is_tracked:
        past = step - round(LATENCY_S * env.control_hz)
        frame = moving_trocars.frame_at(env, measured_rest + _rise(env, disturbance, past))
        measured = _if_active(disturbance, frame, measured)
    p_world_trocar = _if_active(
        disturbance, true_rest + _rise(env, disturbance, step), state.trocar.p_world_trocar
    )
    moved = moving_trocars.move_trocars(env, state, p_world_trocar)
    return env.step(moved.replace(measured_trocar=measured), command), disturbance.memory


def _if_active(disturbance: DisturbanceState, changed: Tree, default: Tree) -> Tree:
    """Returns `changed` above level 0, else `default`, which other disturbances may have set."""
    return jax.tree.map(lambda x, y: jnp.where(disturbance.level > 0, x, y), changed, default)


TROCAR_OFFSET = Disturbance(
    description="the measured trocar is off by this distance",
    unit="mm",
    levels=(0.0, 1.0, 2.0, 5.0, 10.0),
    stream="trocar_told",
    on_params=_offset,
    for_demos=False,
)
BREATHING = Disturbance(
    description="the true trocar moves with the breath; the measured one rests",
    unit="mm",
    levels=(0.0, 2.0, 5.0),
    on_reset=_rest,
    on_step=lambda *step: _breathe(*step, is_tracked=False),
    for_demos=False,
)
BREATHING_TRACKED = Disturbance(
    description=(
        f"the true trocar moves with the breath; the measured one follows {1e3 * LATENCY_S:g} ms "
        "late"
    ),
    unit="mm",
    levels=(0.0, 2.0, 5.0),
    stream="breathing_late",
    on_reset=_rest,
    on_step=lambda *step: _breathe(*step, is_tracked=True),
    for_demos=False,
)
