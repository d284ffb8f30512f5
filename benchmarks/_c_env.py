"""Environments whose physics is C MuJoCo on one thread: whole episodes without compiling MJX.

Everything else is the environment's own: controller, inverse kinematics, measurements, status.
"""

import copy
import functools
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from starjax.sim import coupling, dynamics, physics
from starjax.sim.env import Env
from starjax.sim.scene import Scene
from starjax.sim.task import Contacts

ITERATIONS = 50  # iterations of C MuJoCo's solver: the models' own are those of `sim.solver`
# Contacts that touch and measurements may see: two tools on a needle have up to 50. Our own physics
# keeps fewer, the nearest.
CONTACTS = 64
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
    blank = Contacts(jnp.zeros((CONTACTS, 2), jnp.int32), jnp.ones(CONTACTS))
    m, run = scene.mj_model, functools.partial(_each, functools.partial(_run, memory, scene))

    def steps(state: physics.PhysicsState, ctrl: jax.Array, applied: jax.Array) -> Any:
        bare = state.replace(memory=None)
        shapes = jax.tree.map(
            lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype),
            (bare, jnp.zeros((len(ctrl), m.nq)), blank),
        )
        return jax.pure_callback(
            run, shapes, bare, ctrl, applied, p_world_trocar, vmap_method="broadcast_all"
        )

    if scene.task.coupling is None:
        after, qpos, contacts = steps(state, ctrl, jnp.zeros(m.nv))
    else:  # with forces that are computed before every step

        def substep(carry: tuple[physics.PhysicsState, Contacts], ctrl: jax.Array) -> Any:
            state, _ = carry
            forces, own = coupling.forces(scene, layout, state, gripper, p_world_trocar)
            after, qpos, contacts = steps(state, ctrl[None], forces)
            return (after.replace(memory=own), contacts), qpos[0]

        (after, contacts), qpos = jax.lax.scan(substep, (state, blank), ctrl)
    touch = physics.touching(scene, contacts)
    return after, physics.StepResult(touch, contacts, qpos, jnp.zeros(()))


def _each(run: Callable[..., Any], state: Any, ctrl: np.ndarray, *others: np.ndarray) -> Any:
    """Runs the episodes of a batch one after another: one call of Python for all of them."""
    if ctrl.ndim == 2:
        return run(state, ctrl, *others)
    batch = jax.tree.map(np.asarray, (state, ctrl, *others))
    rows = (jax.tree.map(lambda x, i=i: x[i], batch) for i in range(len(ctrl)))
    return jax.tree.map(lambda *x: np.stack(x), *(_each(run, *row) for row in rows))


def _run(
    memory: dict[str, Any],
    scene: Scene,
    state: physics.PhysicsState,
    ctrl: np.ndarray,
    applied: np.ndarray,
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
    data.qfrc_applied[:] = applied
    before = np.zeros((len(ctrl), m.nq), np.float32)
    for i in range(len(ctrl)):
        before[i] = data.qpos
        data.ctrl[:] = ctrl[i]
        mujoco.mj_step(m, data)
    geom, dist = np.zeros((CONTACTS, 2), np.int32), np.ones(CONTACTS, np.float32)
    count = min(data.ncon, CONTACTS)
    geom[:count], dist[:count] = data.contact.geom[:count], data.contact.dist[:count]
    after = physics.PhysicsState(
        *(np.float32(x) for x in (data.qpos, data.qvel, data.qacc_warmstart))
    )
    return after, before, Contacts(geom, dist)
