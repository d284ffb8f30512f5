"""MJX under the environment: the state between steps, and one control period."""

import types
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.spatial.transform import Rotation

from starjax.core.types import ArrayTree
from starjax.sim import coupling, solver
from starjax.sim.quiet_mjx import mjx
from starjax.sim.scene import BoundArm, Scene
from starjax.sim.task import Contacts

# Beyond it the solver has diverged (rad/s, of an arm's joints).
MAX_ARM_SPEED = 20.0


@flax.struct.dataclass
class PhysicsState:
    """All of `mjx.Data` that the next step needs.

    Attributes:
      qpos: `[Q]`. qvel, qacc_warmstart: `[V]`.
      memory: of `Task.coupling`, None without one.
    """

    qpos: jax.Array
    qvel: jax.Array
    qacc_warmstart: jax.Array
    memory: Any = None


class StepResult(NamedTuple):
    """Outcome of a control period.

    Attributes:
      touch: `[A]` bool, contact of a pad with something graspable in the last substep.
      contacts: of the last substep.
      qpos: `[substeps, Q]` at the start of each substep.
      solver_error: J, the largest energy that the contact solver's error may hold in a substep.
    """

    touch: jax.Array
    contacts: Contacts
    qpos: jax.Array
    solver_error: jax.Array


def initial(
    scene: Scene,
    q: Sequence[jax.Array],
    layout: ArrayTree,
    p_world_trocar: jax.Array | None = None,
) -> PhysicsState:
    """Returns the state at rest: arms at `q` (`[J]` rad), jaws open, objects placed.

    Objects that tools hold need the trocars `[A, 3]` m; by default these are the nominal ones.
    """
    qpos = jnp.asarray(scene.mj_model.qpos0, jnp.float32)
    for bound, q_arm in zip(scene.arms, q, strict=True):
        qpos = qpos.at[bound.q].set(q_arm)
        if bound.jaws.size:
            qpos = qpos.at[bound.jaws].set(bound.tool.open)
    qpos = scene.task.place_objects(scene.bound, qpos, layout)
    at = jnp.asarray(scene.p_world_ref) if p_world_trocar is None else p_world_trocar
    qpos, memory = coupling.begin(scene, layout, qpos, at)
    still = jnp.zeros(scene.mj_model.nv)
    return PhysicsState(qpos=qpos, qvel=still, qacc_warmstart=still, memory=memory)


def no_contacts(scene: Scene) -> Contacts:
    """Returns the contacts before the first step, all apart."""
    contact = scene.mjx_data._impl.contact
    shape = contact.dist.shape
    return Contacts(jnp.zeros((*shape, 2), jnp.int32), jnp.ones(shape))


def advance(
    scene: Scene,
    state: PhysicsState,
    q: Sequence[jax.Array],
    dq: Sequence[jax.Array],
    velocity: Sequence[jax.Array],
    gripper: jax.Array,
    p_world_trocar: jax.Array,
    period: float,
    layout: ArrayTree,
    time: jax.Array,
    own: Mapping[str, jax.Array] = types.MappingProxyType({}),
) -> tuple[PhysicsState, StepResult]:
    """Advances one control period: joint targets move smoothly from `q` to `q + dq`.

    Targets follow the cubic that begins at `velocity` and ends at `dq / period`. Its velocity and
    acceleration are fed forward: else changes of speed would swing the long tool off its trocar.

    Args:
      q, dq: of every arm, `[J]` rad. velocity: of every arm, `[J]` rad/s, of the target before.
      gripper: `[A]` in [-1, 1].
      p_world_trocar: `[A, 3]` m.
      period: s.
      layout: of the episode, for `Task.drive`. time: s since reset.
      own: the episode's own fields of the MJX model.
    """
    substeps = round(period / scene.mj_model.opt.timestep)
    mjx_model = _model(scene, p_world_trocar).replace(**own)
    mocap_pos = scene.mjx_data.mocap_pos.at[scene.trocar_mocap].set(p_world_trocar)
    target = servo_targets(scene, q, dq, velocity, gripper, period, layout, time)

    def substep(i, carry):
        state, result = carry
        before = result.qpos.at[i].set(state.qpos)
        data = scene.mjx_data.replace(
            qpos=state.qpos,
            qvel=state.qvel,
            qacc_warmstart=state.qacc_warmstart,
            # A new target each substep: a step in the target would be a blow to the servo.
            ctrl=target(i),
            mocap_pos=mocap_pos,
        )
        forces, memory = coupling.forces(scene, layout, state, gripper, p_world_trocar)
        data, error = solver.step(mjx_model, data, scene.max_solver_iterations, forces)
        contacts = Contacts(jnp.asarray(data._impl.contact.geom), data._impl.contact.dist)
        # One bad substep makes the whole period invalid
        error = jnp.maximum(result.solver_error, error)
        # Only the fields of the next substep: the loop would carry all of mjx.Data.
        state = PhysicsState(data.qpos, data.qvel, data.qacc_warmstart, memory)
        return state, StepResult(touching(scene, contacts), contacts, before, error)

    blank = StepResult(
        jnp.zeros(len(scene.arms), bool),
        no_contacts(scene),
        jnp.zeros((substeps, scene.mj_model.nq)),
        jnp.zeros(()),
    )
    # The lanes of `state` from the beginning: `vmap` would trace the body again for a result that
    # gets them in the loop. XLA folds a selection of equal values.
    is_finite = jnp.isfinite(state.qpos[0])
    blank = jax.tree.map(lambda x: jax.lax.select(is_finite, x, x), blank)
    return jax.lax.fori_loop(0, substeps, substep, (state, blank))


def servo_targets(
    scene: Scene,
    q: Sequence[jax.Array],
    dq: Sequence[jax.Array],
    velocity: Sequence[jax.Array],
    gripper: jax.Array,
    period: float,
    layout: ArrayTree,
    time: jax.Array,
) -> Callable[[jax.Array], jax.Array]:
    """Returns the function from a substep to all servos' targets `[nu]`; arguments as `advance`."""
    substeps = round(period / scene.mj_model.opt.timestep)
    turn = [period * v - d for v, d in zip(velocity, dq, strict=True)]

    def target(i: jax.Array) -> jax.Array:
        s = (i + 1) / substeps
        ctrl = jnp.zeros(scene.mj_model.nu)
        for a, bound in enumerate(scene.arms):
            # Cubic Hermite spline of s in [0, 1]: a straight line plus a term for the first slope.
            # x(0) = q, x'(0) = velocity, x(1) = q + dq
            x = q[a] + s * dq[a] + s * (1 - s) ** 2 * turn[a]
            v = (dq[a] + (1 - s) * (1 - 3 * s) * turn[a]) / period  # dx/ds / period
            # A critically damped servo lags its input by 2/w v + a/w^2: added in advance.
            acceleration = (6 * s - 4) * turn[a] / period**2  # d2x/ds2 / period^2
            w = bound.arm.servo_frequency
            ctrl = ctrl.at[bound.ctrl].set(x + 2.0 / w * v + acceleration / w**2)
            if bound.jaw_ctrl is not None:
                ctrl = ctrl.at[bound.jaw_ctrl].set(_jaw_target(bound, gripper[a]))
        return scene.task.drive(scene.bound, layout, ctrl, time + s * period)

    return target


def is_sound(scene: Scene, state: PhysicsState) -> jax.Array:
    """Returns False once the simulation has diverged (not finite, or implausibly fast)."""
    sound = jax.tree.reduce(lambda ok, x: ok & jnp.all(jnp.isfinite(x)), state, jnp.ones((), bool))
    for bound in scene.arms:
        arm = bound.dof[: bound.joints]  # a wrist may be faster
        sound &= jnp.max(jnp.abs(state.qvel[arm])) < MAX_ARM_SPEED
    return sound & scene.task.is_sound(scene.bound, state.qpos, state.qvel)


def openings(scene: Scene, qpos: jax.Array) -> jax.Array:
    """Returns the jaws' measured openings `[A]`: -1 closed on nothing, +1 fully open."""
    values = [
        # Without jaws: open
        jnp.ones(()) if bound.jaw is None else 2.0 * qpos[bound.jaw] / bound.tool.open - 1.0
        for bound in scene.arms
    ]
    return jnp.clip(jnp.stack(values), -1.0, 1.0)


def kinematics(
    scene: Scene, qpos: jax.Array, p_world_trocar: jax.Array, layout: ArrayTree | None = None
) -> mjx.Data:
    """Computes the poses of all bodies and geoms, with markers at `p_world_trocar` `[A, 3]` m.

    With a layout the bodies of `Task.still` are placed too.
    """
    mocap_pos = scene.mjx_data.mocap_pos.at[scene.trocar_mocap].set(p_world_trocar)
    data = scene.mjx_data.replace(qpos=qpos, mocap_pos=mocap_pos)
    if scene.task.still is not None and layout is not None:
        still = scene.task.still(layout)
        # scipy's order is x y z w, MuJoCo's w x y z.
        turn = jnp.roll(Rotation.from_matrix(still.R).as_quat(), 1, axis=-1)  # w first
        data = data.replace(
            mocap_pos=mocap_pos.at[scene.still_mocap].set(still.p),
            mocap_quat=data.mocap_quat.at[scene.still_mocap].set(turn),
        )
    return mjx.kinematics(_model(scene, p_world_trocar), data)


def touching(scene: Scene, contacts: Contacts) -> jax.Array:
    """Returns `[A]` bool, True if a pad overlaps something graspable."""
    close = contacts.dist < 0  # overlap: MJX keeps pairs that are only near, too
    held = jnp.any(_any_of(contacts.geom, scene.graspable), axis=-1)  # [C]: one of both geoms
    touched = [
        jnp.any(close & held & jnp.any(_any_of(contacts.geom, bound.pads), axis=-1))
        for bound in scene.arms
    ]
    return jnp.stack(touched)


def _model(scene: Scene, p_world_trocar: jax.Array) -> mjx.Model:
    """Returns the model with the bases of remote centres at `p_world_trocar` `[A, 3]` m.

    In MJX, children of a mocap body follow its `body_pos`, not its mocap position.
    """
    if not any(bound.arm.remote_centre for bound in scene.arms):
        return scene.mjx_model
    bodies = np.array([scene.mj_model.body(f"trocar{i}").id for i in range(len(scene.arms))])
    body_pos = jnp.asarray(scene.mjx_model.body_pos).at[bodies].set(p_world_trocar)
    return scene.mjx_model.replace(body_pos=body_pos)


def _jaw_target(bound: BoundArm, gripper: jax.Array) -> jax.Array:
    return bound.tool.closed + 0.5 * (gripper + 1.0) * (bound.tool.open - bound.tool.closed)


def _any_of(geom: jax.Array, ids) -> jax.Array:
    return jnp.any(geom[..., None] == jnp.asarray(ids), axis=-1)
