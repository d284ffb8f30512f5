"""The environment: reset, step(Command), observe, as single-sample pure functions.

It takes poses and knows no method. What varies per episode is in `EnvParams` and the key, so a
batch of trocars is one vmapped axis.
"""

import functools
import numbers
from collections.abc import Callable
from typing import NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from starjax import errors, rcm
from starjax.sim import collision, control, ik, physics, render, scene
from starjax.sim.tasks.peg_transfer import task
from starjax.sim.types import Observation
from starjax.types import Command, Pose

CONTROL_HZ = 30.0
RESET_IK_ITERATIONS = 40
STEP_IK_ITERATIONS = 4
# Of a command's R'R from the identity: float32 and somebody's rounding are far below.
MAX_SKEW = 0.01
# FR5 data sheet, the slower joints (rad/s).
MAX_JOINT_SPEED = 3.15


@flax.struct.dataclass
class EnvParams:
    """What the caller chooses for an episode: where the port is, a `Trocar` of scalars."""

    trocar: rcm.Trocar


@flax.struct.dataclass
class EnvState:
    """One episode. Every array is `[]` or as said; batches come from vmap.

    Attributes:
      sim: joint positions, velocities, warm start.
      q_target: `[6]` rad, joint target of the last command; q_velocity: `[6]` rad/s, the target's;
        velocity: `[7]` of the reference pose, lean: `[3]` m, see `tracking`; gripper_target:
        [-1, 1].
      trocar, source, target: the episode's port and its pegs (int32).
      target_peg: `[2]` m, the target's axis. p_world_ref: `[3]` m, the nominal port.
      step: int32, control steps taken. settled: consecutive steps that look like success.
      done: nothing moves any more: success, or invalid.
      success: strict, see `peg_transfer`. loose: SurRoL's test was met at some step.
      invalid: the simulation diverged, and the last sound state is kept; or the port is not finite.
      collided: arm, shaft or jaws were where they have no modelled contact.
      rcm_error: m, executed: distance of the port from the measured tool axis.
      rcm_error_within: m, the largest such distance at any physics step of the last control step.
      ik_error: m, residual of the IK, rotations weighed; inf after a command that is not finite, or
        whose R is no rotation: the arm holds.
      jaw_contact: the jaws touch the block.
      pose, block_pose: measured tip and block in the world. gripper: measured opening, [-1, 1].
    """

    sim: physics.PhysicsState
    q_target: jax.Array
    q_velocity: jax.Array
    velocity: jax.Array
    lean: jax.Array
    gripper_target: jax.Array
    trocar: rcm.Trocar
    source: jax.Array
    target: jax.Array
    target_peg: jax.Array
    p_world_ref: jax.Array
    step: jax.Array
    settled: jax.Array
    done: jax.Array
    success: jax.Array
    loose: jax.Array
    invalid: jax.Array
    collided: jax.Array
    rcm_error: jax.Array
    rcm_error_within: jax.Array
    ik_error: jax.Array
    jaw_contact: jax.Array
    pose: Pose
    gripper: jax.Array
    block_pose: Pose


class Env(NamedTuple):
    """The simulation as pure functions of one episode.

    Attributes:
      reset: (key, EnvParams) -> EnvState
      step: (EnvState, Command) -> EnvState, one control period; the state of a done episode stays.
      observe: EnvState -> Observation
      camera: EnvState -> render.Frame, what the camera sees at the observation's size.
      p_world_ref: `[3]` m, the nominal port o_ref.
      model: the static model; control_hz: commands a second.
    """

    reset: Callable[[jax.Array, EnvParams], EnvState]
    step: Callable[[EnvState, Command], EnvState]
    observe: Callable[[EnvState], Observation]
    camera: Callable[[EnvState], "render.Frame"]
    p_world_ref: np.ndarray
    model: scene.SimModel
    control_hz: float


def make(policy_observation: str = "image", image_size: int = 256, shadow: bool = True) -> Env:
    """Builds the peg-transfer environment.

    Args:
      policy_observation: "image" (pixels) or "state" (block pose and target position instead).
      image_size: pixels a side of the camera's square picture.

    Raises:
      ValueError: an unknown observation, an unusable size, or jax in double precision.
    """
    if jnp.result_type(float) == jnp.float64:
        raise errors.UsageError("JAX_ENABLE_X64", "it off", "on", "the simulation is in float32")
    if policy_observation not in ("image", "state"):
        raise ValueError(
            f"policy_observation: expected 'image' or 'state', got {policy_observation!r}"
        )
    if not isinstance(image_size, numbers.Integral) or image_size < 16:
        raise ValueError(
            f"image_size: expected 16 pixels or more, a whole number, got {image_size!r}"
        )
    sim = scene.load()
    draw = render.make(sim.mj_model, "camera", image_size, image_size, shadow=shadow)
    pegs = jnp.asarray(sim.pegs)

    def reset(key: jax.Array, params: EnvParams) -> EnvState:
        layout = task.sample_layout(key, pegs)
        start = jnp.concatenate([jnp.zeros(1), layout.tip])
        pose, _ = rcm.ACTION_SPACES["rcm4"].decode(start, params.trocar, sim.p_world_ref)
        q, ik_error = ik.solve(sim.arm, pose, jnp.asarray(sim.home), RESET_IK_ITERATIONS)
        no = jnp.zeros((), bool)
        port = rcm.trocar_position(params.trocar, sim.p_world_ref)
        is_lost = ~jnp.all(jnp.isfinite(port))
        state = EnvState(
            sim=physics.initial(sim, q, layout.block),
            q_target=q,
            q_velocity=jnp.zeros_like(q),
            velocity=jnp.zeros(7),
            lean=jnp.zeros(3),
            gripper_target=jnp.ones(()),
            trocar=params.trocar,
            source=layout.source,
            target=layout.target,
            target_peg=pegs[layout.target],
            p_world_ref=jnp.asarray(sim.p_world_ref),
            step=jnp.zeros((), jnp.int32),
            settled=jnp.zeros((), jnp.int32),
            done=is_lost,
            success=no,
            loose=no,
            invalid=is_lost,
            collided=no,
            rcm_error=jnp.zeros(()),
            rcm_error_within=jnp.zeros(()),
            ik_error=ik_error,
            jaw_contact=no,
            pose=pose,
            gripper=jnp.ones(()),
            block_pose=layout.block,
        )
        return _measure(state)

    def step(state: EnvState, command: Command) -> EnvState:
        port = rcm.trocar_position(state.trocar, sim.p_world_ref)
        leant, _, _ = ik.forward(sim.arm, state.q_target)
        present = control.leaning(leant, port, -state.lean)
        lean = control.hold(state.lean, state.pose, present, port)
        target, velocity = control.toward(
            present, state.velocity, command.pose, port, 1.0 / CONTROL_HZ
        )
        leant = control.leaning(target, port, lean)
        q, _ = ik.solve(sim.arm, leant, state.q_target, STEP_IK_ITERATIONS)
        usable = _is_usable(command) & jnp.all(jnp.isfinite(q))
        dq = jnp.where(usable, q - state.q_target, 0.0)
        fastest = jnp.maximum(jnp.max(jnp.abs(dq)), 1e-9)
        dq = dq * jnp.minimum(1.0, MAX_JOINT_SPEED / CONTROL_HZ / fastest)
        gripper = jnp.where(usable, jnp.clip(command.gripper, -1.0, 1.0), state.gripper_target)
        after, jaw_contact, passed = physics.advance(
            sim, state.sim, state.q_target, dq, state.q_velocity, gripper, 1.0 / CONTROL_HZ
        )
        between, _, _ = jax.vmap(ik.forward, in_axes=(None, 0))(sim.arm, passed)
        moved = state.replace(
            sim=after,
            q_target=state.q_target + dq,
            q_velocity=CONTROL_HZ * dq,
            velocity=jnp.where(usable, velocity, 0.0),
            lean=jnp.where(usable, lean, state.lean),
            gripper_target=gripper,
            step=state.step + 1,
            ik_error=jnp.where(
                usable,
                ik.residual(
                    sim.arm, control.leaning(command.pose, port, lean), state.q_target + dq
                ),
                jnp.inf,
            ),
            jaw_contact=jaw_contact,
            rcm_error_within=jnp.max(rcm.rcm_error(between, port)),
        )
        moved = _judge(sim, _measure(moved))
        stopped = state.replace(invalid=jnp.ones((), bool), done=jnp.ones((), bool))
        moved = _select(physics.is_sound(sim, after), moved, stopped)
        return _select(state.done, state, moved)

    def _measure(state: EnvState) -> EnvState:
        q = state.sim.qpos[sim.arm_q : sim.arm_q + 6]
        pose, origins, _ = ik.forward(sim.arm, q)
        block = physics.block_pose(sim, state.sim)
        hit = collision.detect(pose, origins, block, pegs)
        port = rcm.trocar_position(state.trocar, sim.p_world_ref)
        rcm_error = rcm.rcm_error(pose, port)
        return state.replace(
            pose=pose,
            block_pose=block,
            gripper=physics.opening(sim, state.sim),
            rcm_error=rcm_error,
            rcm_error_within=jnp.maximum(state.rcm_error_within, rcm_error),
            collided=state.collided | hit,
        )

    def camera(state: EnvState) -> render.Frame:
        xpos, xmat = physics.geom_poses(
            sim, state.sim.qpos, rcm.trocar_position(state.trocar, sim.p_world_ref)
        )
        return draw(xpos, xmat, physics.colours(sim, state.target))

    def observe(state: EnvState) -> Observation:
        image = task_state = None
        if policy_observation == "image":
            image = camera(state).rgb
        else:
            goal = jnp.append(state.target_peg, task.RIM_HEIGHT)
            block = state.block_pose
            task_state = jnp.concatenate([block.p, rcm.rot6d_encode(block.R), goal])
        return Observation(pose=state.pose, gripper=state.gripper, image=image, state=task_state)

    return Env(
        reset=_precisely(reset),
        step=_precisely(step),
        observe=_precisely(observe),
        camera=_precisely(camera),
        p_world_ref=sim.p_world_ref,
        model=sim,
        control_hz=CONTROL_HZ,
    )


def _judge(sim: scene.SimModel, state: EnvState) -> EnvState:
    """The measured state with its outcome."""
    velocity = state.sim.qvel[sim.block_dof : sim.block_dof + 6]
    threaded = task.is_threaded(state.block_pose, state.target_peg)
    good = threaded & task.is_at_rest(velocity) & ~state.jaw_contact
    settled = jnp.where(good, state.settled + 1, 0)
    success = settled >= task.SETTLE_STEPS
    loose = state.loose | task.is_near(state.block_pose, state.target_peg)
    return state.replace(settled=settled, success=success, loose=loose, done=success)


def _precisely(f: Callable) -> Callable:
    """`f` with float32 products: a GPU's default, TF32, costs the kinematics 0.2 mm."""

    @functools.wraps(f)
    def wrapped(*args):
        with jax.default_matmul_precision("highest"):
            return f(*args)

    return wrapped


def _is_usable(command: Command) -> jax.Array:
    """Finite, and its R a rotation."""
    finite = jax.tree.map(lambda x: jnp.all(jnp.isfinite(x)), command)
    R = command.pose.R
    skew = jnp.max(jnp.abs(R.T @ R - jnp.eye(3)))
    is_rotation = (skew < MAX_SKEW) & (jnp.cross(R[:, 0], R[:, 1]) @ R[:, 2] > 0)
    return jax.tree.reduce(jnp.logical_and, finite) & is_rotation


def _select(which: jax.Array, a: EnvState, b: EnvState) -> EnvState:
    return jax.tree.map(lambda x, y: jnp.where(which, x, y), a, b)
