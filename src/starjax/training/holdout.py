"""Action error on demonstrations kept out of training: open loop, against what was commanded."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from starjax import config, rcm
from starjax.data import windows
from starjax.policies.base import Policy
from starjax.training.state import TrainState

_WINDOWS = 64


def make(
    policy: Policy, policy_config: config.PolicyConfig, dataset: windows.Dataset, frames: np.ndarray
) -> Callable[[TrainState], dict[str, float]] | None:
    """A function from the state to the errors of its average, or None without such frames.

    Args:
      policy: to be judged.
      policy_config: the horizons of a window.
      dataset: the demonstrations, wherever they are.
      frames: `[n]` frame numbers kept out of training; 64 of them, evenly spaced, are used.
    """
    if len(frames) == 0:
        return None
    count = min(_WINDOWS, len(frames))
    chosen = frames[(np.arange(count) * len(frames)) // count]

    def gather(data: windows.Dataset, frame: Any) -> windows.Batch:
        return windows.gather(data, frame, policy_config.obs_horizon, policy_config.horizon)

    batch = (jax.jit(gather) if windows.on_device(dataset) else gather)(dataset, chosen)
    # the same noise each time, so that the curve shows the network and not the draw
    keys = jax.random.split(jax.random.key(0), count)

    @jax.jit
    def errors(params: Any, stats: Any, batch: windows.Batch) -> dict[str, jax.Array]:
        said = policy.sample(params, stats, keys, batch.observation, batch.trocar)
        return action_errors(said, batch.command)

    def evaluate(state: TrainState) -> dict[str, float]:
        found = errors(state.ema_params, state.normalizer, batch)
        return {name: float(value) for name, value in found.items()}

    return evaluate


def action_errors(said: Any, wanted: Any) -> dict[str, jax.Array]:
    """Mean errors of commands `[..., A]`: tip in mm, roll in degrees, gripper in its unit."""
    distance = jnp.linalg.norm(said.pose.p - wanted.pose.p, axis=-1)
    turn = rcm.roll_of(said.pose.R) - rcm.roll_of(wanted.pose.R)
    turn = jnp.abs((turn + jnp.pi) % (2.0 * jnp.pi) - jnp.pi)
    return {
        "position_error_mm": 1e3 * jnp.mean(distance),
        "roll_error_deg": jnp.rad2deg(jnp.mean(turn)),
        "gripper_error": jnp.mean(jnp.abs(said.gripper - wanted.gripper)),
    }
