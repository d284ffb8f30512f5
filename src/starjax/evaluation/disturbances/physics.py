"""Disturbances of robots and objects, whose parameters differ from the model's."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from starjax.evaluation.disturbances.base import Disturbance, DisturbanceState
from starjax.sim.state import Env, EnvState


def _scaled(env: Env, state: EnvState, factors: dict[str, jax.Array]) -> tuple[EnvState, Any]:
    """Scales fields of the episode's MJX model by factors, which broadcast from the left."""
    model = dict(state.model)
    for name, factor in factors.items():
        field = model.get(name, jnp.asarray(getattr(env.scene.mjx_model, name)))
        model[name] = field * factor.reshape(factor.shape + (1,) * (field.ndim - factor.ndim))
    return state.replace(model=model), ()


def _weaken_servos(
    env: Env, disturbance: DisturbanceState, state: EnvState
) -> tuple[EnvState, Any]:
    arm_servos = np.concatenate([arm.ctrl for arm in env.scene.arms])
    factor = jnp.ones(env.scene.mj_model.nu).at[arm_servos].set(1.0 - disturbance.level)
    return _scaled(env, state, {"actuator_gainprm": factor, "actuator_biasprm": factor})


def _reduce_friction(
    env: Env, disturbance: DisturbanceState, state: EnvState
) -> tuple[EnvState, Any]:
    return _scaled(env, state, {"geom_friction": 1.0 - disturbance.level})


def _change_mass(env: Env, disturbance: DisturbanceState, state: EnvState) -> tuple[EnvState, Any]:
    m = env.scene.mj_model
    objects = np.unique(m.geom_bodyid[env.scene.graspable])
    ratio = 1.0 + disturbance.level * jnp.where(jax.random.bernoulli(disturbance.key), 1.0, -1.0)
    factor = jnp.ones(m.nbody).at[objects].set(ratio)
    # Contacts derive their stiffness from the inverse weight, in which a free joint's armature
    # counts as mass.
    mass, armature = m.body_mass[objects], m.dof_armature[m.body_dofadr[objects]]
    inverse_ratio = (mass + armature) / (ratio * mass + armature)
    inverse = jnp.ones(m.nbody).at[objects].set(inverse_ratio)
    fields = {"body_mass": factor, "body_inertia": factor, "body_invweight0": inverse}
    return _scaled(env, state, fields)


WEAK_SERVOS = Disturbance(
    description="the arms' servos are weaker by this fraction",
    unit="",
    levels=(0.0, 0.1, 0.25, 0.5),
    max_level=0.9,
    stream="servos",
    on_reset=_weaken_servos,
)
FRICTION = Disturbance(
    description="all friction is lower by this fraction",
    unit="",
    levels=(0.0, 0.1, 0.25, 0.5),
    max_level=0.9,
    on_reset=_reduce_friction,
)
MASS = Disturbance(
    description="the object is heavier or lighter by this fraction, each in half of the episodes",
    unit="",
    levels=(0.0, 0.25, 0.5),
    max_level=0.9,
    on_reset=_change_mass,
)
