"""Temporal ensembling: a plan at every control step, and the mean of all plans for the moment.

Source: Zhao et al., Learning Fine-Grained Bimanual Manipulation with Low-Cost Hardware (ACT),
section IV-B: the i-th plan for a moment, the oldest first, weighs exp(-DECAY i). Poses are averaged
entry by entry; the mean becomes a rotation again, and of a method on the RCM manifold a pose there.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from starjax import rcm
from starjax.core.types import Command, Pose
from starjax.sim.rollouts import agent
from starjax.sim.state import EnvState

DECAY = 0.01  # a control step, as in ACT


class Memory(NamedTuple):
    """Of N episodes.

    Attributes:
      planner: the memory of the policy that plans.
      total: Command `[N, H, A]`, the weighted sum of the plans for each moment from this one on.
    """

    planner: agent.Plan
    total: Command


@functools.lru_cache(maxsize=4)
def from_policy(
    sample: Callable[..., Command],
    obs_horizon: int,
    keeps_to_manifold: bool,
    wrist: rcm.Wrist | None = None,
) -> agent.BatchAgent:
    """Makes a batch of a policy that averages its plans; `params` are (weights, statistics).

    Args:
      sample: as `Policy.sample`.
      obs_horizon: O, observation horizon, at most 2 because it plans at every control step.
      keeps_to_manifold: True if its poses are on the RCM manifold.
      wrist: that it commands, None for straight ones.
    """
    planner = agent.from_policy(sample, obs_horizon, 1)

    def init(params: Any, keys: jax.Array, state: EnvState, observe: agent.Observe) -> Memory:
        memory = planner.init(params, keys, state, observe)
        return Memory(memory, jax.tree.map(jnp.zeros_like, memory.command))

    def act(
        params: Any, memory: Memory, state: EnvState, observe: agent.Observe, t: jax.Array
    ) -> tuple[Command, Memory, Command]:
        _, planned, _ = planner.act(params, memory.planner, state, observe, t)
        weight, whole = weights(planned.command.gripper.shape[1], t)

        def added(total: jax.Array, plan: jax.Array) -> jax.Array:
            later = jnp.concatenate([total[:, 1:], jnp.zeros_like(total[:, :1])], 1)  # a step on
            return later + weight.reshape(-1, *[1] * (plan.ndim - 2)) * plan

        total = jax.tree.map(added, memory.total, planned.command)
        mean = jax.tree.map(lambda x: x[:, 0] / whole, total)  # sum of w_i plan_i / sum of w_i
        # A mean of rotations needs Gram-Schmidt, which keeps the direction of its first column.
        pose = Pose(rcm.rot6d_decode(rcm.rot6d_encode(mean.pose.R)), mean.pose.p)
        angles, p_world_trocar = mean.wrist, state.measured_trocar.p_world_trocar
        if keeps_to_manifold and wrist is not None:
            pose, angles, _ = rcm.through(wrist, pose, p_world_trocar)
        elif keeps_to_manifold:
            pose = rcm.project(pose, p_world_trocar)  # means of poses on the manifold leave it
        now = Command(pose, mean.gripper, angles)
        return now, Memory(planned, total), now

    return agent.BatchAgent(init, act, {**planner.about, "ensemble": DECAY})


def weights(horizon: int, t: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Returns the weights `[H]` of the plan of control step `t`, one per planned step, and the sum
    of the weights of all plans for the first of these steps."""
    # Older plans that reach this moment
    earlier = jnp.minimum(t, horizon - 1 - jnp.arange(horizon))
    each = jnp.exp(-DECAY * jnp.arange(horizon))
    return each[earlier], jnp.sum(jnp.where(jnp.arange(horizon) <= earlier[0], each, 0.0))
