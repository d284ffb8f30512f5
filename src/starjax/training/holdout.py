"""Action error on demonstrations kept out of training: open loop, against their commands."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from starjax import rcm
from starjax.core import config
from starjax.core.types import Array, Command
from starjax.data import windows
from starjax.data.normalizer import Normalizer
from starjax.policies.base import Params, Policy
from starjax.runtime.precompile import Program
from starjax.training.state import TrainState

_WINDOWS = 64


def make(
    policy: Policy,
    policy_config: config.PolicyConfig,
    dataset: windows.Dataset,
    frames: np.ndarray,
    shapes: TrainState | None = None,
    wrist: rcm.Wrist | None = None,
) -> Callable[[TrainState], dict[str, float]] | None:
    """Makes the function from a state to the errors of its average; None without such frames.

    Args:
      policy: to be judged.
      policy_config: the horizons of a window.
      dataset: the demonstrations, wherever they are.
      frames: `[n]` frame numbers kept out of training; 64 of them, evenly spaced, are used.
      shapes: of the state on one device, for which the function is compiled in the background.
      wrist: that the policy commands, None for straight ones.
    """
    if len(frames) == 0:
        return None
    count = min(_WINDOWS, len(frames))
    chosen = frames[(np.arange(count) * len(frames)) // count]  # evenly over the demonstrations

    def gather(data: windows.Dataset, frame: windows.Array) -> windows.Batch:
        return windows.gather(data, frame, policy_config.obs_horizon, policy_config.horizon)

    batch = (jax.jit(gather) if windows.on_device(dataset) else gather)(dataset, chosen)
    # the same noise each time: the curve shows the network and not the draw
    keys = jax.random.split(jax.random.key(0), count)

    def errors(params: Params, stats: Normalizer, batch: windows.Batch) -> dict[str, jax.Array]:
        predicted = policy.sample(params, stats, keys, batch.observation, batch.trocar)
        p_world_trocar = batch.trocar.p_world_trocar[:, None]
        return action_errors(predicted, batch.command, p_world_trocar, wrist)

    program = Program(errors)
    if shapes is not None:
        program.prepare(*jax.eval_shape(lambda x: (x.ema_params, x.normalizer), shapes), batch)

    def evaluate(state: TrainState) -> dict[str, float]:
        values = program(state.ema_params, state.normalizer, batch)
        return {name: float(value) for name, value in values.items()}

    return evaluate


def action_errors(
    predicted: Command,
    demonstrated: Command,
    p_world_trocar: Array,
    wrist: rcm.Wrist | None = None,
) -> dict[str, jax.Array]:
    """Returns mean errors of commands `[..., A]`: tip in mm, roll in degrees, gripper, RCM in mm.

    With a wrist, roll and RCM error are those of the commanded shafts, and the rotation's is added.

    Args:
      predicted, demonstrated: `[..., A]`.
      p_world_trocar: `[..., A, 3]` m; the RCM error is that of the predicted poses.
      wrist: of commands with angles.
    """
    distance = jnp.linalg.norm(predicted.pose.p - demonstrated.pose.p, axis=-1)
    shafts = [predicted.pose, demonstrated.pose]
    more = {}
    if wrist is not None:
        shafts = [_shaft(wrist, command, p_world_trocar) for command in (predicted, demonstrated)]
        trace = jnp.sum(predicted.pose.R * demonstrated.pose.R, axis=(-2, -1))
        angle = jnp.arccos(jnp.clip((trace - 1.0) / 2.0, -1.0, 1.0))  # trace R = 1 + 2 cos(angle)
        more = {"rotation_error_deg": jnp.rad2deg(jnp.mean(angle))}
    turn = rcm.roll_of(shafts[0].R) - rcm.roll_of(shafts[1].R)
    turn = jnp.abs((turn + jnp.pi) % (2.0 * jnp.pi) - jnp.pi)  # to [0, pi]
    return {
        "position_error_mm": 1e3 * jnp.mean(distance),
        "roll_error_deg": jnp.rad2deg(jnp.mean(turn)),
        "gripper_error": jnp.mean(jnp.abs(predicted.gripper - demonstrated.gripper)),
        "rcm_error_mm": 1e3 * jnp.mean(rcm.rcm_error(shafts[0], p_world_trocar)),
        **more,
    }


def _shaft(wrist: rcm.Wrist, command: Command, p_world_trocar: Array) -> rcm.Pose:
    """Returns the shaft of a command; without recorded angles it passes through the trocar."""
    angles = command.wrist
    if angles is None:
        angles = rcm.angles_through(wrist, command.pose, p_world_trocar)
    return rcm.shaft_of(wrist, command.pose, angles)
