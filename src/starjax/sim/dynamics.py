"""Dynamics of an episode: its first state, and one control period, as pure functions of a scene."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp

from starjax import rcm
from starjax.core.types import Command, Pose
from starjax.sim import arm_motion, collision, ik, physics, solver
from starjax.sim import scene as scenes
from starjax.sim.state import EnvParams, EnvState
from starjax.sim.task import CONTROL_HZ, SimReadings

RESET_IK_ITERATIONS = 40
# Energy (J) of the contact solver's error beyond which a step counts as diverged: it moves an arm's
# first joint by 10 mrad/s. 7 of 1,400 trials exceed 1e-7 at some step without harm.
MAX_SOLVER_ERROR = 1e-4


def reset(scene: scenes.Scene, key: jax.Array, params: EnvParams, cameras: Pose) -> EnvState:
    """Starts an episode with objects and tips drawn by the task, and cameras `[C]`."""
    layout = scene.task.sample(scene.bound, key)
    trocar, measured_trocar = (
        rcm.trocar_frame(parameters, scene.p_world_ref, scene.roll_zero)
        for parameters in (params.trocar, params.measured_trocar or params.trocar)
    )
    count = len(scene.arms)
    tips = scene.task.tips(scene.bound, layout, trocar.p_world_trocar)
    start = jnp.concatenate([jnp.zeros((count, 1)), tips], axis=-1)  # [A, 4]: roll 0 and the tip
    # Alg. 1: any tip has a pose on the manifold
    pose, _ = rcm.ACTION_SPACES["rcm4"].decode(start, trocar)
    solved = [
        arm_motion.reach(
            bound, trocar.p_world_trocar[a], arm_motion.of(pose, a), RESET_IK_ITERATIONS
        )
        for a, bound in enumerate(scene.arms)
    ]
    q = tuple(q for q, _ in solved)
    no = jnp.zeros((), bool)
    # A trocar that is not finite ends the episode at once, without NaN in its lane.
    is_lost = ~jnp.all(jnp.isfinite(trocar.p_world_trocar))
    state = physics.initial(scene, q, layout, trocar.p_world_trocar)
    # Jaws are open unless the task's objects begin between them.
    is_coupled = scene.task.coupling is not None
    opening = physics.openings(scene, state.qpos) if is_coupled else jnp.ones(count)
    touch = jnp.zeros(count, bool)
    still, contacts = jnp.zeros((count, 3)), physics.no_contacts(scene)
    readings = SimReadings(
        state.qpos, state.qvel, pose, still, opening, touch, contacts, state.memory, no
    )
    first = EnvState(
        physics=state,
        q_target=q,
        q_velocity=tuple(jnp.zeros_like(x) for x in q),
        velocity=jnp.zeros((count, arm_motion.velocity_size(scene))),
        correction=jnp.zeros((count, 3)),
        gripper_target=opening,
        trocar=trocar,
        measured_trocar=measured_trocar,
        cameras=cameras,
        layout=layout,
        measurements=scene.task.measure(scene.bound, layout, readings, None),
        step=jnp.zeros((), jnp.int32),
        settled=jnp.zeros((), jnp.int32),
        stage=jnp.zeros((), jnp.int32),
        reward=jnp.zeros(()),
        done=is_lost,
        success=no,
        loose=no,
        lost=no,
        invalid=is_lost,
        collided=no,
        rcm_error=jnp.zeros(count),
        rcm_error_within=jnp.zeros(count),
        ik_error=jnp.stack([error for _, error in solved]),
        solver_error=jnp.zeros(()),
        touch=touch,
        pose=pose,
        gripper=opening,
    )
    first = _measure(scene, first, contacts)
    return first.replace(commanded_shaft=first.shaft)


Advance = Callable[..., tuple[physics.PhysicsState, physics.StepResult]]


def step(
    scene: scenes.Scene, state: EnvState, command: Command, advance: Advance = physics.advance
) -> EnvState:
    """Advances one control period towards `command` `[A]`, with the physics `advance`."""
    moved, after, solver_error = attempt(scene, state, command, advance)
    stopped = state.replace(invalid=jnp.ones((), bool), done=jnp.ones((), bool))
    # The last sound state stays, marked invalid: one diverged lane leaves no NaN in its batch.
    sound = physics.is_sound(scene, after) & (solver_error < max_solver_error(scene))
    moved = _select(sound, moved, stopped)
    return _select(state.done, state, moved)  # finished lanes of a batch stand still


def max_solver_error(scene: scenes.Scene) -> float:
    """Returns the energy (J) of the contact solver's error from which a step is invalid."""
    return MAX_SOLVER_ERROR * solver.size_factor(scene.mj_model.nv)


def attempt(
    scene: scenes.Scene, state: EnvState, command: Command, advance: Advance = physics.advance
) -> tuple[EnvState, physics.PhysicsState, jax.Array]:
    """Simulates one control period, sound or not.

    Returns:
      the state after; that of the physics in it; J, the contact solver's largest error.
    """
    moves = [
        arm_motion.move(scene, a, state, arm_motion.of(command, a)) for a in range(len(scene.arms))
    ]
    dq, velocity, correction, gripper, ik_error = zip(*moves, strict=True)
    p_world_trocar, period = state.trocar.p_world_trocar, 1.0 / CONTROL_HZ
    after, result = advance(
        scene,
        state.physics,
        state.q_target,
        dq,
        state.q_velocity,
        jnp.stack(gripper),
        p_world_trocar,
        period,
        state.layout,
        state.step * period,
        state.model,
    )
    moved = state.replace(
        physics=after,
        # The reference advances from itself, not from the measured joints: lags would add up.
        q_target=tuple(q + d for q, d in zip(state.q_target, dq, strict=True)),
        # rad/s at the period's end, see `servo_targets`
        q_velocity=tuple(CONTROL_HZ * d for d in dq),
        velocity=jnp.stack([_padded(v, state.velocity.shape[-1]) for v in velocity]),
        correction=jnp.stack(correction),
        gripper_target=jnp.stack(gripper),
        step=state.step + 1,
        ik_error=jnp.stack(ik_error),
        solver_error=result.solver_error,
        touch=result.touch,
        rcm_error_within=arm_motion.largest_within(scene, result.qpos, p_world_trocar),
        commanded_shaft=_commanded_shafts(scene, command),
    )
    moved = with_status(scene, _measure(scene, moved, result.contacts))
    return moved, after, result.solver_error


def with_status(scene: scenes.Scene, state: EnvState) -> EnvState:
    """Returns the measured state with its outcome."""
    status = scene.task.status(scene.bound, state.layout, state.measurements)
    settled = jnp.where(status.success_now, state.settled + 1, 0)  # in a row: a bounce starts anew
    success = settled >= scene.task.settle_steps
    return state.replace(
        settled=settled,
        success=success,
        loose=state.loose | status.loose,
        lost=state.lost | status.lost,
        stage=status.stage,
        reward=status.reward,
        done=success | state.lost | status.lost,
    )


def _measure(scene: scenes.Scene, state: EnvState, contacts: "physics.Contacts") -> EnvState:
    qpos, p_world_trocar = state.physics.qpos, state.trocar.p_world_trocar
    kinematics = [
        ik.forward(scenes.chain_at(bound, p_world_trocar[a]), qpos[bound.q])
        for a, bound in enumerate(scene.arms)
    ]
    carried = _stacked([pose for pose, _, _ in kinematics])
    pose, shaft, wrist = carried, None, None
    if arm_motion.has_wrist(scene):
        q = [qpos[bound.q] for bound in scene.arms]
        tips = [
            arm_motion.tip_of(bound, at, q_arm)
            for bound, (at, _, _), q_arm in zip(scene.arms, kinematics, q)
        ]
        pose, shaft = _stacked(tips), carried
        wrist = jnp.stack(
            [arm_motion.angles_of(bound, q_arm) for bound, q_arm in zip(scene.arms, q)]
        )
    opening = physics.openings(scene, qpos)
    # A difference of poses, as a robot's controller would report it.
    velocity = CONTROL_HZ * (pose.p - state.pose.p)
    readings = SimReadings(
        qpos,
        state.physics.qvel,
        pose,
        velocity,
        opening,
        state.touch,
        contacts,
        state.physics.memory,
        state.collided,
    )
    measurements = scene.task.measure(scene.bound, state.layout, readings, state.measurements)
    hit = collision.detect(
        scene.arms,
        pose,
        [origins for _, origins, _ in kinematics],
        p_world_trocar,
        scene.task.obstacles(scene.bound, state.layout, measurements),
        scene.task.floor,
        carried,
    )
    rcm_error = rcm.rcm_error(carried, p_world_trocar)
    return state.replace(
        pose=pose,
        shaft=shaft,
        wrist=wrist,
        gripper=opening,
        measurements=measurements,
        thread=None if scene.task.thread is None else scene.task.thread(measurements),
        rcm_error=rcm_error,
        rcm_error_within=jnp.maximum(state.rcm_error_within, rcm_error),  # the worst substep counts
        collided=state.collided | hit,  # for the whole episode: damage is not undone
    )


def _commanded_shafts(scene: scenes.Scene, command: Command) -> Pose | None:
    """Returns the shafts `[A]` of a command, None in a scene without a wrist."""
    if not arm_motion.has_wrist(scene):
        return None
    commands = [arm_motion.of(command, a) for a in range(len(scene.arms))]
    return _stacked([arm_motion.carried_by(bound, one) for bound, one in zip(scene.arms, commands)])


def _padded(velocity: jax.Array, size: int) -> jax.Array:
    """Returns the velocity of a reference `[size]`: a straight tool's is shorter than a wrist's."""
    missing = size - velocity.shape[-1]
    return jnp.pad(velocity, (0, missing)) if missing else velocity


def _stacked(poses: Sequence[Pose]) -> Pose:
    return jax.tree.map(lambda *x: jnp.stack(x), *poses)


def _select(which: jax.Array, a: EnvState, b: EnvState) -> EnvState:
    return jax.tree.map(lambda x, y: jnp.where(which, x, y), a, b)
