"""Moves one arm for a control period: from a commanded pose to a step of its joints."""

import jax
import jax.numpy as jnp

from starjax import rcm
from starjax.sim import control, ik
from starjax.sim import scene as scenes
from starjax.sim.state import EnvState
from starjax.sim.tasks.base import CONTROL_HZ
from starjax.types import Command, Pose

STEP_IK_ITERATIONS = 4
# Largest entry of R'R - 1 of a command; float32 and rounded inputs stay far below.
MAX_SKEW = 0.01


def move(scene: scenes.Scene, a: int, state: EnvState, command: Command):
    """Returns arm a's motion in a control period: dq, velocity, correction, gripper, residual."""
    bound, p_trocar = scene.arms[a], state.trocar.p_world_trocar[a]
    q_target, last_correction = state.q_target[a], state.correction[a]
    chain = scenes.chain_at(bound, p_trocar)
    reference, _, _ = ik.forward(chain, q_target)
    present = control.corrected(reference, p_trocar, -last_correction)
    correction = control.correct(last_correction, of(state.pose, a), present, p_trocar)
    target, velocity = control.toward(
        present, state.velocity[a], command.pose, p_trocar, 1.0 / CONTROL_HZ
    )
    ik_target = control.corrected(target, p_trocar, correction)
    q, _ = solve(bound, p_trocar, ik_target, q_target, STEP_IK_ITERATIONS)
    usable = _is_usable(command) & jnp.all(jnp.isfinite(q))
    dq = jnp.where(usable, q - q_target, 0.0)
    fastest = jnp.maximum(jnp.max(jnp.abs(dq) / bound.max_speed), 1e-9)
    dq = dq * jnp.minimum(1.0, 1.0 / CONTROL_HZ / fastest)
    goal = control.corrected(command.pose, p_trocar, correction)
    return (
        dq,
        jnp.where(usable, velocity, 0.0),
        jnp.where(usable, correction, last_correction),
        jnp.where(usable, jnp.clip(command.gripper, -1.0, 1.0), state.gripper_target[a]),
        jnp.where(usable, ik.residual(chain, goal, q_target + dq), jnp.inf),
    )


def solve(
    bound: scenes.BoundArm,
    p_world_trocar: jax.Array,
    target: Pose,
    q: jax.Array | None,
    iterations: int,
) -> tuple[jax.Array, jax.Array]:
    """Solves the inverse kinematics of one arm from `q` `[J]`, or from its home."""
    home = jnp.asarray(bound.home)
    chain = scenes.chain_at(bound, p_world_trocar)
    start = home if q is None else q
    return ik.solve(chain, target, start, iterations, home, bound.arm.rest_gain)


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
    skew = jnp.max(jnp.abs(R.T @ R - jnp.eye(3)))
    is_rotation = (skew < MAX_SKEW) & (jnp.cross(R[:, 0], R[:, 1]) @ R[:, 2] > 0)
    return jax.tree.reduce(jnp.logical_and, finite) & is_rotation
