"""Min-max scaling of actions, proprioception and task state to [-1, 1], fitted to demonstrations.

Lengths and angles are scaled; 6-D rotations and the gripper are in [-1, 1] by nature and pass
unchanged. Proprioception is the measured pose in the method's own action space and so shares the
actions' statistics: what was commanded and what was measured stay comparable.
"""

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from starjax import config, rcm
from starjax.data import windows

_SMALLEST_RANGE = 1e-4  # m or rad: below it an entry counts as constant, and is only centred
_STATE_SCALED = np.r_[0:3, 9:12]  # block position and target peg position; 3:9 is a rotation


@flax.struct.dataclass
class MinMax:
    """Affine map of `[low, high]` to [-1, 1], entry by entry.

    Attributes:
      low: `[n]` smallest value seen.
      high: `[n]` largest value seen.
    """

    low: Any
    high: Any

    def normalize(self, x: jax.Array) -> jax.Array:
        return (x - self.low) * (2.0 / (self.high - self.low)) - 1.0

    def denormalize(self, x: jax.Array) -> jax.Array:
        return (x + 1.0) * (0.5 * (self.high - self.low)) + self.low


@flax.struct.dataclass
class Normalizer:
    """All scalings of one method.

    Attributes:
      action: of the encoded pose and the gripper, `[A + 1]`.
      state: of the task state, `[12]`, or None where it is not observed.
    """

    action: MinMax
    state: MinMax | None


def encode(
    action_space: str, pose: Any, gripper: Any, trocar: rcm.Trocar, p_world_ref: Any
) -> jax.Array:
    """A pose and a gripper as one vector `[..., A + 1]` of the action space, not yet scaled."""
    space = rcm.ACTION_SPACES[action_space]
    encoded = space.encode(pose, trocar, p_world_ref)
    return jnp.concatenate([encoded, jnp.asarray(gripper)[..., None]], axis=-1)


def fit(
    method: config.Method, dataset: windows.Dataset, p_world_ref: Any, frames: np.ndarray
) -> Normalizer:
    """Statistics of the commands (and the task state) at the given frames of a dataset.

    Args:
      method: whose action space to use.
      dataset: the demonstrations, wherever they are.
      p_world_ref: `[3]` m nominal port.
      frames: `[n]` frame numbers, those trained on.
    """
    encode_commands = jax.jit(
        lambda command, trocar: encode(
            method.action_space, command.pose, command.gripper, trocar, p_world_ref
        )
    )
    actions = windows.over_frames(
        dataset, frames, lambda _, command, trocar: encode_commands(command, trocar)
    )
    space = rcm.ACTION_SPACES[method.action_space]
    scaled = [i for name, part in space.slices.items() if name != "R" for i in _entries(part)]
    state = None
    if dataset.observation.state is not None:
        states = windows.over_frames(dataset, frames, lambda observation, *_: observation.state)
        state = _min_max(states, _STATE_SCALED)
    return Normalizer(action=_min_max(actions, np.asarray(scaled)), state=state)


def _entries(part: slice) -> range:
    return range(part.start, part.stop)


def _min_max(values: np.ndarray, scaled: np.ndarray) -> MinMax:
    if not np.isfinite(values).all():
        raise ValueError("dataset: expected finite poses and states, got NaN or infinity")
    low, high = values.min(axis=0), values.max(axis=0)
    # a constant entry is centred and keeps its unit's scale, so that noise on it is not blown up
    constant = high - low < _SMALLEST_RANGE
    middle = 0.5 * (low + high)
    low, high = np.where(constant, middle - 1.0, low), np.where(constant, middle + 1.0, high)
    unchanged = np.ones(values.shape[-1], bool)
    unchanged[scaled] = False
    low, high = np.where(unchanged, -1.0, low), np.where(unchanged, 1.0, high)
    return MinMax(jnp.asarray(low, jnp.float32), jnp.asarray(high, jnp.float32))
