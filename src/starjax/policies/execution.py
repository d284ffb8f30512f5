"""From a normalised action to a command that the environment can always execute."""

from typing import Any

import jax
import jax.numpy as jnp

from starjax import methods, rcm
from starjax.data import normalizer
from starjax.types import Command


def command(
    method: methods.Method,
    stats: normalizer.Normalizer,
    action: jax.Array,
    trocar: rcm.Trocar,
    p_world_ref: Any,
) -> Command:
    """Commands `[B, H]` of normalised actions `[B, H, A + 1]`, the gripper last.

    A non-finite action becomes its action space's hold pose, with the jaws closed: what is held
    is not dropped.

    Args:
      method: gives the action space, and whether poses are projected onto the RCM manifold.
      stats: of the method.
      action: from the networks, any values.
      trocar: `[B]`.
      p_world_ref: `[3]` m, the nominal port.
    """
    per_step = jax.tree.map(lambda leaf: jnp.asarray(leaf)[:, None], trocar)
    vector = stats.action.denormalize(action)
    space = rcm.ACTION_SPACES[method.action_space]
    pose, is_valid = space.decode(vector[..., :-1], per_step, p_world_ref)
    if method.projects:
        pose = rcm.project(pose, rcm.trocar_position(per_step, p_world_ref))
    gripper = vector[..., -1]
    is_valid &= jnp.isfinite(gripper)
    gripper = jnp.where(is_valid, jnp.clip(gripper, -1.0, 1.0), -1.0)
    return Command(pose=pose, gripper=gripper)
