"""Moves one arm for a control period: from a commanded pose to a step of its joints."""

import jax
import jax.numpy as jnp

from starjax import rcm
from starjax.core.types import Command, Pose
from starjax.sim import control, ik, wrist_motion
from starjax.sim import scene as scenes
from starjax.sim.state import EnvState
from starjax.sim.task import CONTROL_HZ

STEP_IK_ITERATIONS = 4
# Largest entry of R'R - 1 of a command; float32 and rounded inputs stay far below.
MAX_SKEW = 0.01


def move(scene: scenes.Scene, a: int, state: EnvState, command: Command):
    """Returns arm a's motion in a control period: dq, velocity, correction, gripper, residual."""
    bound, p_trocar = scene.arms[a], state.trocar.p_world_trocar[a]
    q_target, last_correction = state.q_target[a], state.correction[a]
    chain = scenes.chain_at(bound, p_trocar)
    reference, _, _ = ik.forward(chain, q_target)  # where the target is, not the lagging arm
    # Without the correction for load: the reference must not drift with it.
    present = control.corrected(reference, p_trocar, -last_correction)
    measured = state.pose if state.shaft is None else state.shaft
    # Integral feedback
    correction = control.correct(last_correction, of(measured, a), present, p_trocar)
    wanted = carried_by(bound, command)
    if bound.tool.wrist is None:
        target, velocity = control.toward(
            present, state.velocity[a], wanted, p_trocar, 1.0 / CONTROL_HZ
        )
        # Turned about the tip, against the load
        ik_target = control.corrected(target, p_trocar, correction)
        q, _ = solve(bound, p_trocar, ik_target, q_target, STEP_IK_ITERATIONS)
    else:
        tip, point, velocity = wrist_motion.toward(
            wrist_motion.tip_of(bound, reference, q_target),
            control.nearest(present, p_trocar),
            state.velocity[a],
            command.pose,
            control.nearest(wanted, p_trocar),
            1.0 / CONTROL_HZ,
        )
        ik_target, angles = wrist_motion.carried(bound.tool.wrist, tip, point + correction)
        q, _ = solve(bound, p_trocar, ik_target, q_target[: bound.joints], STEP_IK_ITERATIONS)
        q = jnp.concatenate([q, angles])
    usable = _is_usable(command) & jnp.all(jnp.isfinite(q))
    # An unusable command holds the arm: it never moves on a doubt.
    dq = jnp.where(usable, q - q_target, 0.0)
    fastest = jnp.maximum(jnp.max(jnp.abs(dq) / bound.max_speed), 1e-9)
    dq = dq * jnp.minimum(1.0, 1.0 / CONTROL_HZ / fastest)  # the slowest joint sets the pace of all
    goal = control.corrected(wanted, p_trocar, correction)
    return (
        dq,
        jnp.where(usable, velocity, 0.0),
        jnp.where(usable, correction, last_correction),
        jnp.where(usable, jnp.clip(command.gripper, -1.0, 1.0), state.gripper_target[a]),
        jnp.where(usable, ik.residual(chain, goal, q_target + dq), jnp.inf),
    )


def carried_by(bound: scenes.BoundArm, command: Command) -> Pose:
    """Returns the commanded pose of the frame that the arm carries: shaft, or tip."""
    if bound.tool.wrist is None:
        return command.pose
    return wrist_motion.shaft_of(bound, command.pose, command.wrist)


def solve(
    bound: scenes.BoundArm,
    p_world_trocar: jax.Array,
    target: Pose,
    q: jax.Array | None,
    iterations: int,
) -> tuple[jax.Array, jax.Array]:
    """Solves the inverse kinematics of one arm without its wrist, from `q` or from its home."""
    home = jnp.asarray(bound.home)[: bound.joints]
    chain = scenes.chain_at(bound, p_world_trocar)
    start = home if q is None else q
    return ik.solve(chain, target, start, iterations, home, bound.arm.rest_gain)


def reach(
    bound: scenes.BoundArm, p_world_trocar: jax.Array, tip: Pose, iterations: int
) -> tuple[jax.Array, jax.Array]:
    """Solves for all joints `[J]` of a tip pose from the home, the wrist straight."""
    if bound.tool.wrist is None:
        return solve(bound, p_world_trocar, tip, None, iterations)
    q, residual = solve(
        bound, p_world_trocar, wrist_motion.shaft_of(bound, tip, None), None, iterations
    )
    return jnp.concatenate([q, jnp.zeros(2)]), residual


def has_wrist(scene: scenes.Scene) -> bool:
    """Returns True if a tool of the scene has a wrist."""
    return any(bound.tool.wrist is not None for bound in scene.arms)


def velocity_size(scene: scenes.Scene) -> int:
    """Returns the size of a reference's velocity."""
    return wrist_motion.VELOCITY if has_wrist(scene) else control.VELOCITY


def angles_of(bound: scenes.BoundArm, q: jax.Array) -> jax.Array:
    """Returns the angles `[2]` rad of an arm's wrist, zeros for a straight tool."""
    return jnp.zeros(2) if bound.tool.wrist is None else q[bound.joints :]


def tip_of(bound: scenes.BoundArm, carried: Pose, q: jax.Array) -> Pose:
    """Returns pose_world_tip for the pose at the end of an arm's chain and its joints `[J]`."""
    return carried if bound.tool.wrist is None else wrist_motion.tip_of(bound, carried, q)


def largest_within(scene: scenes.Scene, qpos: jax.Array, p_world_trocar: jax.Array) -> jax.Array:
    """Returns the largest RCM error `[A]` m over the physics steps `qpos` `[substeps, Q]`."""
    largest = []
    for a, bound in enumerate(scene.arms):
        chain = scenes.chain_at(bound, p_world_trocar[a])
        pose, _, _ = jax.vmap(ik.forward, in_axes=(None, 0))(chain, qpos[:, bound.q])
        largest.append(jnp.max(rcm.rcm_error(pose, p_world_trocar[a])))
    return jnp.stack(largest)


def of(tree: Pose | Command, a: int):
    """Returns the part of arm a."""
    return jax.tree.map(lambda leaf: leaf[a], tree)


def _is_usable(command: Command) -> jax.Array:
    """Returns True if the command is finite and its R a rotation."""
    finite = jax.tree.map(lambda x: jnp.all(jnp.isfinite(x)), command)
    R = command.pose.R
    skew = jnp.max(jnp.abs(R.T @ R - jnp.eye(3)))  # R' R = I for a rotation
    # det R > 0: no mirror
    is_rotation = (skew < MAX_SKEW) & (jnp.cross(R[:, 0], R[:, 1]) @ R[:, 2] > 0)
    return jax.tree.reduce(jnp.logical_and, finite) & is_rotation
