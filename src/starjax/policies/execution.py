"""From a normalised action to a command that the environment can always execute."""

import jax
import jax.numpy as jnp

from starjax import rcm
from starjax.core import methods
from starjax.core.types import Command
from starjax.data import normalizer
from starjax.policies import features


def command(
    method: methods.Method,
    stats: normalizer.Normalizer,
    action: jax.Array,
    trocar: rcm.TrocarFrame,
    wrist: rcm.Wrist | None = None,
) -> Command:
    """Decodes normalised actions `[B, H, A * (dim + 1)]` to commands `[B, H, A]`.

    A non-finite action of an arm becomes its action space's hold pose with the jaws closed, which
    keeps a held object.

    Args:
      method: gives the action space, and whether poses are projected onto the RCM manifold.
      stats: of the method.
      action: from the networks, any values.
      trocar: `[B, A]`.
      wrist: of the tools, for a method that commands its angles.
    """
    frame = features.per_step(trocar)
    space = rcm.action_space(method.action_space, wrist)
    vector = stats.action.denormalize(action)
    vector = vector.reshape(*vector.shape[:-1], -1, space.dim + 1)
    pose, is_valid = space.decode(vector[..., :-1], frame)
    angles = None
    if wrist is None:
        pose = rcm.project(pose, frame.p_world_trocar) if method.projects else pose
    elif normalizer.keeps_to_manifold(method):  # a feasible pose stays as it is
        pose, angles, _ = rcm.through(wrist, pose, frame.p_world_trocar)
    else:
        limit = jnp.array([wrist.pitch, wrist.yaw])
        angles = jnp.clip(vector[..., space.slices["wrist"]], -limit, limit)
        angles = jnp.where(is_valid[..., None], angles, 0.0)
    gripper = vector[..., -1]
    is_valid &= jnp.isfinite(gripper)
    gripper = jnp.where(is_valid, jnp.clip(gripper, -1.0, 1.0), -1.0)
    return Command(pose=pose, gripper=gripper, wrist=angles)
