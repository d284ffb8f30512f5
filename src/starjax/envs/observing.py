"""Observations of an agent: features of order one, optionally with images.

`tool` has a robot's measurements and its measured trocar, arm after arm:

- its pose in the action space, in [-1, 1] within `ranges.actions`, and its jaws' opening;
- the controller's velocity of the tip (3) and of the roll (1), as fractions of the largest;
- 7 features of its trocar (`policies.features.trocar_features`).

With `state` the task's fields follow, points scaled by the tip's box, and `Task.relative`. With
`image` the cameras' images accompany `tool`.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from starjax.envs import ranges
from starjax.policies import features
from starjax.sim import control
from starjax.sim.state import Env, EnvState
from starjax.sim.task import Task

LARGEST = 10.0  # numbers are clipped here
_FASTEST = np.array([control.MAX_SPEED] * 3 + [control.MAX_SPIN], np.float32)


def make(env: Env, scaled: Callable[[Any], jax.Array]) -> Callable[[Any], Any]:
    """Makes EnvState -> `[O]` float32 or `{camera's name: [h, w, 3] uint8, "tool": [O] float32}`.

    Args:
      env: `sim.env.Env`.
      scaled: EnvState -> measured poses, scaled, and openings.
    """
    task: Task = env.task
    low, high = (end[0] for end in ranges.tips(task))

    def tool(state: EnvState) -> jax.Array:
        speed = state.velocity[:, :4] / _FASTEST
        trocar = features.trocar_features(state.measured_trocar.trocar)
        parts = [scaled(state), speed.ravel(), trocar.ravel()]
        return jnp.concatenate(parts)

    def observe(state: EnvState) -> Any:
        observation = env.observe(state)
        if observation.images is not None:
            return {**observation.images, "tool": _clipped(tool(state))}
        assert observation.state is not None
        parts, at = [tool(state)], 0
        for field in task.fields:
            part = observation.state[at : at + field.size]
            at += field.size
            parts.append((2 * part - high - low) / (high - low) if field.kind == "point" else part)
        parts.append(task.relative(observation.state, state.pose.p))
        return _clipped(jnp.concatenate(parts))

    return observe


def _clipped(x: jax.Array) -> jax.Array:
    return jnp.clip(x, -LARGEST, LARGEST).astype(jnp.float32)
