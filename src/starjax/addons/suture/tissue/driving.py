"""A needle between jaws and tissue: the forces of one physics step.

The needle is light: its velocity after the step is found implicitly, with the tips' present motion,
and the forces that lead to it are applied to it and to the tools.
"""

from typing import NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from starjax.addons.suture.tissue import hole, patch
from starjax.addons.suture.tissue import rows as bodies
from starjax.addons.suture.tissue.needle import Needle
from starjax.core.types import Pose

GRAVITY = 9.81


@flax.struct.dataclass
class Tissue:
    """State of a hole, and of the patches `[A]` of the tools."""

    hole: hole.NeedleHole
    patches: patch.Patch


class Body(NamedTuple):
    """The needle's free body.

    Attributes:
      inertia: `[6]` kg, kg m^2, along its axes, with the joint's armature. mass: kg.
    """

    inertia: np.ndarray
    mass: float


class Tips(NamedTuple):
    """Tools at one moment.

    Attributes:
      pose: Pose `[A]` in the world. twist: `[A, 6]` m/s, rad/s in the world.
      gripper: `[A]` in [-1, 1], commanded.
    """

    pose: Pose
    twist: jax.Array
    gripper: jax.Array


class Forces(NamedTuple):
    """Forces of a step, N and N m: on the needle `[6]`, like its velocity, and on tips `[A, 6]`."""

    needle: jax.Array
    tips: jax.Array


def weight(body: Body) -> jax.Array:
    """Returns the needle's weight `[6]` N, N m, like its velocity."""
    return jnp.zeros(6).at[2].set(-GRAVITY * body.mass)


def begin(needle: Needle, tips: Pose, pose: Pose, is_held: jax.Array) -> Tissue:
    """Returns the state of a needle outside tissue, held by the tools `is_held` `[A]`."""
    patches = jax.vmap(lambda tip, held: patch.grasped(needle, tip, pose, held))(tips, is_held)
    return Tissue(hole.none(), patches)


def step(
    needle: Needle, body: Body, tissue: Tissue, pose: Pose, u: jax.Array, tips: Tips, h: float
) -> tuple[Forces, Tissue]:
    """Returns the forces of a step and the state after it, single-sample.

    Args:
      pose: pose_world_needle. u: `[6]`, its velocity, see `rows`.
      h: s.
    """
    now = hole.advance(needle, pose, tissue.hole)
    patches = jax.vmap(patch.closed, in_axes=(None, 0, 0, None, 0))(
        needle, tissue.patches, tips.pose, pose, tips.gripper
    )
    held, patches = jax.vmap(patch.rows, in_axes=(0, 0, 0, None, 0))(
        patches, tips.pose, tips.twist, pose, tips.gripper
    )
    flat = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), held)
    rows = bodies.joined([hole.rows(needle, pose, now), flat])
    inertia = jnp.asarray(body.inertia, jnp.float32)
    _, forces = bodies.solve(rows, inertia, u + h * weight(body) / inertia, u, h)
    on_patches = forces[hole.ROWS :].reshape(len(tips.gripper), 6)
    axes = tips.pose.R @ patches.R_tip_patch
    on_tips = -jnp.concatenate(
        [jnp.einsum("aij,aj->ai", axes, on_patches[:, part]) for part in (slice(3), slice(3, 6))],
        -1,
    )
    now = hole.with_forces(now, forces[: hole.ROWS])
    return Forces(forces @ rows.J, on_tips), Tissue(now, patches)
