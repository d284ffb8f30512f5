"""Min-max scaling of actions, proprioception and task state to [-1, 1], fitted to demonstrations.

Lengths and angles are scaled; 6-D rotations and the gripper are in [-1, 1] by nature and pass
unchanged. Proprioception is the measured pose in the method's own action space and so shares the
actions' statistics: what was commanded and what was measured stay comparable.

A policy's samples are clipped to [-1, 1], so what was demonstrated is as far as a tool can be sent.
Where positions or depths count from the port, samples reach farther: to the demonstrated tips as
seen from any port that may be drawn (Eq. 19), since from a higher port a tip is farther away.
"""

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from starjax import methods, rcm
from starjax.data import windows

_SMALLEST_RANGE = 1e-4  # m or rad: below it an entry counts as constant, and is only centred
_ABSOLUTE = ("se3", "rcm4")  # action spaces whose positions are the world's, whatever the port
_EDGE_AZIMUTHS = 16  # of ports on the edge of Eq. 19: between two of them up to 1 mm is missing
_STATE_SCALED = np.r_[0:3, 9:12]  # block position and target peg position; 3:9 is a rotation


@flax.struct.dataclass
class MinMax:
    """Affine map of `[low, high]` to [-1, 1], entry by entry.

    Attributes:
      low: `[n]` smallest value seen.
      high: `[n]` largest value seen.
      reach: `[2, n]` lowest and highest sample, scaled, or None: -1 and 1.
    """

    low: Any
    high: Any
    reach: Any = None

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
    method: methods.Method, dataset: windows.Dataset, p_world_ref: Any, frames: np.ndarray
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
    action = _min_max(actions, _entries_but(space, "R"))
    if method.action_space not in _ABSOLUTE:
        action = action.replace(reach=_reach(action, space, dataset, frames, p_world_ref))
    state = None
    if dataset.observation.state is not None:
        states = windows.over_frames(dataset, frames, lambda observation, *_: observation.state)
        state = _min_max(states, _STATE_SCALED)
    return Normalizer(action=action, state=state)


def _reach(
    box: MinMax,
    space: rcm.ActionSpace,
    dataset: windows.Dataset,
    frames: np.ndarray,
    p_world_ref: Any,
) -> jax.Array:
    """`[2, A + 1]`, scaled: what the commanded tips ask for through the ports of the edge.

    Those are the highest, lowest and outermost ones of Eq. 19, and the centre: {T} turns there too.
    """
    around = np.linspace(*rcm.AZIMUTH_RANGE, _EDGE_AZIMUTHS, endpoint=False)
    heights = [*rcm.POLAR_RANGE, np.mean(rcm.POLAR_RANGE)]
    ports = rcm.Trocar(*(x.ravel() for x in np.meshgrid(rcm.RADIUS_RANGE, heights, around)))

    @jax.jit
    def ends(command):
        def through(port):
            pose = rcm.project(command.pose, rcm.trocar_position(port, p_world_ref))
            scaled = box.normalize(encode(space.name, pose, command.gripper, port, p_world_ref))
            return scaled.min(axis=0), scaled.max(axis=0)

        low, high = jax.vmap(through)(ports)
        return jnp.concatenate([low, high])

    edge = windows.over_frames(dataset, frames, lambda _, command, __: ends(command))
    reach = np.stack([np.full(edge.shape[-1], -1.0), np.full(edge.shape[-1], 1.0)])
    counted = _entries_but(space, "R", "roll")
    reach[0, counted] = np.minimum(edge[:, counted].min(axis=0), -1.0)
    reach[1, counted] = np.maximum(edge[:, counted].max(axis=0), 1.0)
    return jnp.asarray(reach, jnp.float32)


def _entries_but(space: rcm.ActionSpace, *names: str) -> np.ndarray:
    """Where the parts lie in the space's vector, without those of these names."""
    parts = [part for name, part in space.slices.items() if name not in names]
    return np.concatenate([np.arange(part.start, part.stop) for part in parts])


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
