"""Environments whose physics is C MuJoCo on one thread: whole episodes without compiling MJX.

Everything else is the environment's own: controller, inverse kinematics, measurements, status.
"""

import copy
import functools
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from starjax.sim import dynamics, physics
from starjax.sim.env import Env
from starjax.sim.scene import Scene
from starjax.sim.tasks.base import Contacts

ITERATIONS = 50  # of C MuJoCo's solver: the models' own are those of `sim.solver`
NO_FIELDS: Mapping[str, Any] = MappingProxyType({})


def with_c_physics(env: Env) -> Env:
    """Returns the environment with C MuJoCo's steps; batches run one after another."""
    step = functools.partial(dynamics.step, env.scene, advance=functools.partial(_advance, {}))

    def precise(*args: Any) -> Any:
        with jax.default_matmul_precision("highest"):
            return step(*args)

    return env._replace(step=precise)


def _advance(
    memory: dict[str, Any],
    scene: Scene,
    state: physics.PhysicsState,
    q: Sequence[jax.Array],
    dq: Sequence[jax.Array],
    velocity: Sequence[jax.Array],
    gripper: jax.Array,
    p_world_trocar: jax.Array,
    period: float,
    layout: object,
    time: jax.Array,
    own: Mapping[str, jax.Array] = NO_FIELDS,
) -> tuple[physics.PhysicsState, physics.StepResult]:
    """Does as `physics.advance`; an episode's own fields of the model are not supported."""
    assert not own
    substeps = round(period / scene.mj_model.opt.timestep)
    target = physics.servo_targets(scene, q, dq, velocity, gripper, period, layout, time)
    ctrl = jax.vmap(target)(jnp.arange(substeps))
    blank = physics.no_contacts(scene)
    shapes = jax.tree.map(
        lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype),
        (state, jnp.zeros((substeps, scene.mj_model.nq)), blank),
    )
    run = functools.partial(_run, scene, substeps, len(blank.dist), memory)
    after, qpos, contacts = jax.pure_callback(
        run, shapes, state, ctrl, p_world_trocar, vmap_method="sequential"
    )
    touch = physics.touching(scene, contacts)
    return after, physics.StepResult(touch, contacts, qpos, jnp.zeros(()))


def _run(
    scene: Scene,
    substeps: int,
    most: int,
    memory: dict[str, Any],
    state: physics.PhysicsState,
    ctrl: np.ndarray,
    p_world_trocar: np.ndarray,
) -> tuple[physics.PhysicsState, np.ndarray, Contacts]:
    if "data" not in memory:
        m = copy.copy(scene.mj_model)
        m.opt.iterations, m.opt.ls_iterations, m.opt.tolerance = ITERATIONS, ITERATIONS, 1e-10
        memory.update(model=m, data=mujoco.MjData(m))
    m, data = memory["model"], memory["data"]
    data.mocap_pos[scene.trocar_mocap] = p_world_trocar
    data.qpos[:], data.qvel[:] = state.qpos, state.qvel
    data.qacc_warmstart[:] = state.qacc_warmstart
    before = np.zeros((substeps, m.nq), np.float32)
    for i in range(substeps):
        before[i] = data.qpos
        data.ctrl[:] = ctrl[i]
        mujoco.mj_step(m, data)
    geom, dist = np.zeros((most, 2), np.int32), np.ones(most, np.float32)
    count = min(data.ncon, most)
    geom[:count], dist[:count] = data.contact.geom[:count], data.contact.dist[:count]
    after = physics.PhysicsState(
        *(np.float32(x) for x in (data.qpos, data.qvel, data.qacc_warmstart))
    )
    return after, before, Contacts(geom, dist)
