"""A needle whose jaws follow a given path, without an arm: for tests and figures."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from starjax.addons.suture.tissue import driving
from starjax.addons.suture.tissue import rows as bodies
from starjax.addons.suture.tissue.needle import Needle
from starjax.core.types import Pose
from starjax.sim import ik


class DriveMoment(NamedTuple):
    """One moment of a simulation.

    Attributes:
      pose: pose_world_needle. u: `[6]`, its velocity, see `rows`.
      tissue: state of hole and patch.
      force: `[6]` N and N m, of the needle on the tip.
      power: W, of the jaws.
    """

    pose: Pose
    u: jax.Array
    tissue: driving.Tissue
    force: jax.Array
    power: jax.Array


def run(
    needle: Needle, body: driving.Body, tips: Pose, start: Pose, gripper: jax.Array, h: float
) -> DriveMoment:
    """Simulates a needle that begins in the jaws; traceable.

    Args:
      tips: poses `[T + 1]` of the tip, `h` s apart.
      start: pose_world_needle.
      gripper: command of the jaws.

    Returns:
      the moments `[T]` after each step.
    """
    one = jnp.ones(1, bool)
    first, before, after = (
        jax.tree.map(lambda leaf, part=part: leaf[part], tips)
        for part in (slice(1), slice(-1), slice(1, None))
    )

    def step(carry: tuple, path: tuple[Pose, Pose]) -> tuple:
        (pose, u, tissue), (tip, following) = carry, path
        turn = ik.rotation_between(tip.R, following.R)
        twist = jnp.concatenate([following.p - tip.p, turn]) / h
        now = driving.Tips(Pose(tip.R[None], tip.p[None]), twist[None], jnp.reshape(gripper, 1))
        forces, tissue = driving.step(needle, body, tissue, pose, u, now, h)
        u = u + h * (forces.needle + driving.weight(body)) / jnp.asarray(body.inertia)
        pose = Pose(pose.R @ bodies.rotation(h * u[3:]), pose.p + h * u[:3])
        power = -forces.tips[0] @ twist
        return (pose, u, tissue), DriveMoment(pose, u, tissue, forces.tips[0], power)

    tissue = driving.begin(needle, first, start, one)
    return jax.lax.scan(step, (start, jnp.zeros(6), tissue), (before, after))[1]
