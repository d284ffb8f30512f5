"""Trocars that move during an episode, as with a patient who breathes or is turned."""

import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.core.types import Command
from starjax.sim import arm_motion, wrist_motion, wrists
from starjax.sim.scene import BoundArm
from starjax.sim.state import Env, EnvState
from starjax.sim.task import Task

HELD = 1e-5  # m; a commanded shaft this near to its trocar counts as passing it


def move_trocars(env: Env, state: EnvState, p_world_trocar: jax.Array) -> EnvState:
    """Returns the state with its true and measured trocars moved; unmoved ones keep their bits.

    The arms have not moved: until they do, their tools miss the trocars. The next steps bring them
    back at the controller's own pace (`sim.control`). The base of a mechanical remote centre moves
    with its trocar: its joints turn at once, and the tip stays without a pull at its object.

    Args:
      p_world_trocar: `[A, 3]` m.
    """
    # Selected, not recomputed: a trocar that stays must keep its last bits.
    is_moved = jnp.any(p_world_trocar != state.trocar.p_world_trocar)
    moved = frame_at(env, p_world_trocar)
    trocar, measured_trocar = (
        jax.tree.map(lambda new, old: jnp.where(is_moved, new, old), moved, frame)
        for frame in (state.trocar, state.measured_trocar)
    )
    state = state.replace(trocar=trocar, measured_trocar=measured_trocar)
    for a, bound in enumerate(env.scene.arms):
        if bound.arm.remote_centre:
            dq = jnp.where(is_moved, _turn_about(bound, a, state), 0.0)
            targets = (q + dq if arm == a else q for arm, q in enumerate(state.q_target))
            physics = state.physics.replace(qpos=state.physics.qpos.at[bound.q].add(dq))
            state = state.replace(physics=physics, q_target=tuple(targets))
    return state


def _turn_about(bound: BoundArm, a: int, state: EnvState) -> jax.Array:
    """Returns the turn `[J]` rad of arm a that keeps its tip although its base has moved."""
    p_trocar, q = state.trocar.p_world_trocar[a], state.physics.qpos[bound.q]
    tip, angles = jax.tree.map(lambda leaf: leaf[a], state.pose), q[bound.joints :]
    target = rcm.project(tip, p_trocar)
    if bound.tool.wrist is not None:
        target, angles = wrist_motion.carried(bound.tool.wrist, tip, p_trocar)
    iterations = arm_motion.STEP_IK_ITERATIONS
    wanted, _ = arm_motion.solve(bound, p_trocar, target, q[: bound.joints], iterations)
    return jnp.concatenate([wanted, angles]) - q


def frame_at(env: Env, p_world_trocar: jax.Array) -> rcm.TrocarFrame:
    """Returns the frames of trocars at `p_world_trocar` `[A, 3]` m."""
    roll_zero = np.array([slot.roll_zero for slot in env.task.slots], np.float32)
    parameters = rcm.trocar_from_position(p_world_trocar, env.p_world_ref)
    return rcm.trocar_frame(parameters, env.p_world_ref, roll_zero)


def carried(task: Task, command: Command, p_before: jax.Array, p_now: jax.Array) -> Command:
    """Turns a command that was planned for other trocars, so its shaft passes the present ones.

    The tip is kept, see `rcm.project`; a wrist keeps its rotation too, see `rcm.through`. Commands
    that missed their trocar when planned, as free poses do, and those whose trocar has not moved
    are returned unchanged.

    Args:
      task: whose slots name the tools.
      command: `[..., A]`.
      p_before, p_now: `[..., A, 3]` m, trocars at the time of the plan and now.
    """
    held = rcm.rcm_error(wrists.shafts(task, command), p_before) < HELD  # a plan on the manifold
    is_other = held & jnp.any(p_before != p_now, axis=-1)
    turned = command._replace(pose=rcm.project(command.pose, p_now))
    if command.wrist is not None:
        bends = jnp.array([wrist is not None for wrist in wrists.per_arm(task)])
        turned = _chosen(bends, wrists.through(task, command, p_now), turned)
    return _chosen(is_other, turned, command)


def _chosen(which: jax.Array, first: Command, second: Command) -> Command:
    """Returns the first command of the arms `[..., A]` that `which` has, the second of others."""
    axes = first.gripper.ndim

    def choose(a: jax.Array, b: jax.Array) -> jax.Array:
        ones = (1,) * (a.ndim - axes)
        return jnp.where(which.reshape(*which.shape, *ones), a, b)

    return jax.tree.map(choose, first, second)


def toward(here: jax.Array, there: jax.Array, largest: float) -> jax.Array:
    """Returns the point `[..., 3]` m from `here` towards `there`, at most `largest` m away."""
    way = there - here
    length = jnp.linalg.norm(way, axis=-1, keepdims=True)
    return jnp.where(length > largest, here + way * (largest / jnp.maximum(length, 1e-9)), there)
