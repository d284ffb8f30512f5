"""Commands between two commands of a policy, on the RCM manifold, for arms of 100 to 200 Hz."""

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from starjax import rcm
from starjax.core.types import Command, Pose
from starjax.deploy import plan_motion

_STILL = 1e-9  # m and rad; of less no fraction is taken


@functools.lru_cache
def of(wrist: rcm.Wrist | None, steps: int) -> Callable[..., list[Command]]:
    """Returns (last, target, p_world_trocar) -> the `steps` commands from `last` to `target`.

    All lie on the manifold; the last is `target`. Jaws move evenly.
    """
    toward = plan_motion.of(wrist).toward
    fractions = np.arange(1, steps + 1, dtype=np.float32) / steps

    @jax.jit
    def poses(last: Pose, target: Pose, p_world_trocar: jax.Array) -> Pose:
        _, move, turn = toward(last, target, p_world_trocar, jnp.inf, jnp.inf)

        def part(fraction: ArrayLike) -> Pose:
            most = (jnp.where(x > _STILL, fraction * x, jnp.inf) for x in (move, turn))
            return toward(last, target, p_world_trocar, *most)[0]

        return jax.vmap(part)(fractions)

    def commands(last: Command, target: Command, p_world_trocar: np.ndarray) -> list[Command]:
        R, p = jax.device_get(poses(last.pose, target.pose, p_world_trocar))
        jaws = [last.gripper + f * (target.gripper - last.gripper) for f in fractions]
        return [Command(Pose(R[i], p[i]), jaws[i]) for i in range(steps)]

    return commands
