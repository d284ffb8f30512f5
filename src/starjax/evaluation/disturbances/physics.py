"""Robots and objects that are not as they were modelled."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from starjax.evaluation.disturbances.base import Disturbance, Now
from starjax.sim.state import Env, EnvState


def _scaled(env: Env, state: EnvState, factors: dict[str, jax.Array]) -> tuple[EnvState, Any]:
    """The state with fields of its MJX model times factors, which broadcast from the left."""
    own = dict(state.model)
    for name, factor in factors.items():
        field = own.get(name, jnp.asarray(getattr(env.scene.mjx_model, name)))
        own[name] = field * factor.reshape(factor.shape + (1,) * (field.ndim - factor.ndim))
    return state.replace(model=own), ()


def _weaken(env: Env, now: Now, state: EnvState) -> tuple[EnvState, Any]:
    of_arms = np.concatenate([bound.ctrl for bound in env.scene.arms])
    factor = jnp.ones(env.scene.mj_model.nu).at[of_arms].set(1.0 - now.level)
    return _scaled(env, state, {"actuator_gainprm": factor, "actuator_biasprm": factor})


def _grease(env: Env, now: Now, state: EnvState) -> tuple[EnvState, Any]:
    return _scaled(env, state, {"geom_friction": 1.0 - now.level})


def _weigh(env: Env, now: Now, state: EnvState) -> tuple[EnvState, Any]:
    m = env.scene.mj_model
    objects = np.unique(m.geom_bodyid[env.scene.graspable])
    times = 1.0 + now.level * jnp.where(jax.random.bernoulli(now.key), 1.0, -1.0)
    factor = jnp.ones(m.nbody).at[objects].set(times)
    # What contacts take their stiffness from; a free joint's armature counts as mass there.
    mass, armature = m.body_mass[objects], m.dof_armature[m.body_dofadr[objects]]
    lighter = (mass + armature) / (times * mass + armature)
    softer = jnp.ones(m.nbody).at[objects].set(lighter)
    fields = {"body_mass": factor, "body_inertia": factor, "body_invweight0": softer}
    return _scaled(env, state, fields)


SERVOS = Disturbance(
    what="the arms' servos are weaker by this share",
    unit="",
    levels=(0.0, 0.1, 0.25, 0.5),
    most=0.9,
    begin=_weaken,
)
FRICTION = Disturbance(
    what="everything is more slippery, with friction less by this share",
    unit="",
    levels=(0.0, 0.1, 0.25, 0.5),
    most=0.9,
    begin=_grease,
)
MASS = Disturbance(
    what="the object is heavier or lighter by this share, half of the episodes each",
    unit="",
    levels=(0.0, 0.25, 0.5),
    most=0.9,
    begin=_weigh,
)
