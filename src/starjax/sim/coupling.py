"""Forces of `Task.coupling`, added to those of the contact solver."""

from typing import Any

import jax
import jax.numpy as jnp

from starjax.core.types import ArrayTree, Pose
from starjax.sim import ik, wrist_motion
from starjax.sim import scene as scenes
from starjax.sim.task import StepReadings


def begin(
    scene: scenes.Scene, layout: ArrayTree, qpos: jax.Array, p_world_trocar: jax.Array
) -> tuple[jax.Array, Any]:
    """Returns the coordinates with the objects that tools hold, and the memory at reset."""
    task = scene.task
    if task.coupling is None:
        return qpos, None
    tips = [_tip(bound, qpos, p_world_trocar[a])[1] for a, bound in enumerate(scene.arms)]
    return task.coupling.begin(scene.bound, layout, qpos, _stacked(tips))


def forces(
    scene: scenes.Scene,
    layout: ArrayTree,
    state: Any,
    gripper: jax.Array,
    p_world_trocar: jax.Array,
) -> tuple[jax.Array | None, Any]:
    """Returns the generalised forces `[V]` and the memory after them, or None of both.

    Args:
      state: `physics.PhysicsState` at the start of the step.
      gripper: `[A]`, commanded. p_world_trocar: `[A, 3]` m.
    """
    task = scene.task
    if task.coupling is None:
        return None, None
    tips, jacobians = [], []
    for a, bound in enumerate(scene.arms):
        tip, jacobian = _moving(bound, state.qpos, p_world_trocar[a])
        tips.append(tip)
        jacobians.append(jnp.zeros((6, scene.mj_model.nv)).at[:, bound.dof].set(jacobian))
    motion = StepReadings(
        qpos=state.qpos,
        qvel=state.qvel,
        pose=_stacked(tips),
        jacobian=jnp.stack(jacobians),
        gripper=gripper,
        timestep=scene.mj_model.opt.timestep,
    )
    return task.coupling.forces(scene.bound, layout, state.memory, motion)


def _tip(bound: scenes.BoundArm, qpos: jax.Array, p_trocar: jax.Array) -> tuple[Pose, Pose]:
    """Returns the poses at the end of an arm's chain and of its tip."""
    q = qpos[bound.q]
    carried, _, _ = ik.forward(scenes.chain_at(bound, p_trocar), q[: bound.joints])
    tip = carried if bound.tool.wrist is None else wrist_motion.tip_of(bound, carried, q)
    return carried, tip


def _moving(bound: scenes.BoundArm, qpos: jax.Array, p_trocar: jax.Array) -> tuple[Pose, jax.Array]:
    """Returns pose_world_tip and its Jacobian `[6, J]` (m/s and rad/s in the world)."""
    carried, tip = _tip(bound, qpos, p_trocar)
    chain = scenes.chain_at(bound, p_trocar)
    arm = ik.jacobian(chain, qpos[bound.q][: bound.joints], 1.0)
    moves, turns = arm[:3], arm[3:]
    moves = moves + jnp.cross(turns.T, tip.p - carried.p).T  # v_tip = v + w x (p_tip - p)
    if bound.tool.wrist is not None:
        # Pitch turns about y of the shaft's frame, yaw about x of the tip's; see `rcm.wrist`.
        axes = jnp.stack([carried.R[:, 1], tip.R[:, 0]])
        origins = jnp.stack([carried.p, tip.p - bound.tool.wrist.jaws * tip.R[:, 2]])
        moves = jnp.concatenate([moves, jnp.cross(axes, tip.p - origins).T], 1)
        turns = jnp.concatenate([turns, axes.T], 1)
    return tip, jnp.concatenate([moves, turns])


def _stacked(poses: list[Pose]) -> Pose:
    return jax.tree.map(lambda *x: jnp.stack(x), *poses)
