"""Disturbances of wrists, whose cables have slack."""

import jax
import jax.numpy as jnp

from starjax import rcm
from starjax.core.types import Command, Pose
from starjax.evaluation.disturbances.base import Disturbance, DisturbanceState
from starjax.sim.state import Env, EnvState


def _with_slack(
    env: Env, disturbance: DisturbanceState, state: EnvState, command: Command
) -> tuple[EnvState, jax.Array | None]:
    """Advances one step; the memory is the wrists' angles `[A, 2]` rad, None without a wrist.

    Play: an angle moves only when the command pulls it, at the end of the slack.
    """
    before = disturbance.memory
    if before is None:
        return env.step(state, command), None
    to = jnp.zeros_like(before) if command.wrist is None else command.wrist
    slack = jnp.deg2rad(disturbance.level)
    angles = jnp.clip(before, to - slack, to + slack)
    angles = jnp.where(jnp.isfinite(angles), angles, before)
    pose = jax.tree.map(
        lambda moved, tip: jnp.where(slack > 0.0, moved, tip),
        _carried(env, command.pose, to, angles),
        command.pose,
    )
    return env.step(state, command._replace(pose=pose, wrist=angles)), angles


def _carried(env: Env, tips: Pose, to: jax.Array, angles: jax.Array) -> Pose:
    """Returns the tips `[A]` on the commanded shafts, with wrists at `angles` in place of `to`."""
    found = []
    for a, bound in enumerate(env.scene.arms):
        tip, wrist = Pose(tips.R[a], tips.p[a]), bound.tool.wrist
        if wrist is not None:
            tip = rcm.tip_of(wrist, rcm.shaft_of(wrist, tip, to[a]), angles[a])
        found.append(tip)
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *found)


CABLE_SLACK = Disturbance(
    description="wrists follow their commands late and off by up to this angle: their cables have "
    "slack",
    unit="degrees",
    levels=(0.0, 1.0, 2.0, 5.0),
    max_level=20.0,
    on_reset=lambda env, disturbance, state: (state, state.wrist),
    on_step=_with_slack,
    wrist_only=True,
)
