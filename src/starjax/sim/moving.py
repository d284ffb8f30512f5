"""Trocars that move during an episode, as those of a patient who is turned or breathes do."""

import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.sim.state import Env, EnvState


def trocars_to(env: Env, state: EnvState, p_world_trocar: jax.Array) -> EnvState:
    """The state with its trocars elsewhere, of which agents are told; what stays keeps its bits.

    The arms have not moved: until they do, their tools miss the trocars. The next steps bring them
    back at the controller's own pace (`sim.control`).

    Args:
      p_world_trocar: `[A, 3]` m.
    """
    is_moved = jnp.any(p_world_trocar != state.trocar.p_world_trocar)
    roll_zero = np.array([slot.roll_zero for slot in env.task.slots], np.float32)
    moved = rcm.trocar_frame(
        rcm.trocar_from_position(p_world_trocar, env.p_world_ref), env.p_world_ref, roll_zero
    )
    trocar, told = (
        jax.tree.map(lambda new, old: jnp.where(is_moved, new, old), moved, frame)
        for frame in (state.trocar, state.told)
    )
    return state.replace(trocar=trocar, told=told)


def toward(here: jax.Array, there: jax.Array, most: float) -> jax.Array:
    """`[..., 3]` m: from `here` to `there`, `most` m at most."""
    way = there - here
    length = jnp.linalg.norm(way, axis=-1, keepdims=True)
    return jnp.where(length > most, here + way * (most / jnp.maximum(length, 1e-9)), there)
