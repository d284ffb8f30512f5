"""Min-max scaling of actions, proprioception and task state to [-1, 1], fitted to demonstrations.

Lengths and angles are scaled; 6-D rotations and the gripper are in [-1, 1] by nature and pass
unchanged. Proprioception is the measured pose in the method's own action space and so shares the
actions' statistics: what was commanded and what was measured stay comparable.

A policy's samples are clipped to [-1, 1], the demonstrated range. If positions or depths are
relative to the trocar, the range grows to the demonstrated tips seen from any trocar of Eq. 19,
since a tip is farther from a higher trocar.

Vectors hold the arms one after another: each its pose in the action space, then its gripper.
"""

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from starjax import rcm
from starjax.core import errors, methods
from starjax.core.types import Pose
from starjax.data import windows
from starjax.sim import wrists
from starjax.sim.task import Field, Task

_SMALLEST_RANGE = 1e-4  # m or rad: below it an entry counts as constant, and is only centred
_EDGE_AZIMUTHS = 16  # for trocars on the edge of Eq. 19: between two of them up to 1 mm is missing


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
        return (x - self.low) * (2.0 / (self.high - self.low)) - 1.0  # [low, high] -> [-1, 1]

    def denormalize(self, x: jax.Array) -> jax.Array:
        return (x + 1.0) * (0.5 * (self.high - self.low)) + self.low


@flax.struct.dataclass
class Normalizer:
    """All scalings of one method.

    Attributes:
      action: of what `encode` gives, `[A * (dim + 1)]`.
      state: of the task state, `[S]`, or None where it is not observed.
    """

    action: MinMax
    state: MinMax | None


def encode(
    action_space: str,
    pose: Pose,
    gripper: ArrayLike,
    trocar: rcm.TrocarFrame,
    wrist: rcm.Wrist | None = None,
    angles: ArrayLike | None = None,
) -> jax.Array:
    """Encodes poses and grippers `[..., A]` as one vector `[..., A * (dim + 1)]`, unscaled.

    Args:
      action_space: name for `rcm.action_space`, whose vectors have `dim` entries.
      pose: of the tips, `[..., A]`.
      gripper: `[..., A]`.
      trocar: frames, broadcastable against the poses.
      wrist: of the tools, for a space with `for_wrist`.
      angles: `[..., A, 2]` rad of the wrist, for such a space that is free; without them the shaft
        is taken to pass through the trocar.
    """
    space = rcm.action_space(action_space, wrist)
    encoded = space.encode(pose, trocar)
    if angles is not None and wrist is not None and space.is_free:
        encoded = encoded.at[..., space.slices["wrist"]].set(angles)
    vector = jnp.concatenate([encoded, jnp.asarray(gripper)[..., None]], axis=-1)
    return vector.reshape(*vector.shape[:-2], -1)


def fit(
    method: methods.Method,
    task: Task,
    dataset: windows.Dataset,
    frames: np.ndarray,
) -> Normalizer:
    """Computes statistics of commands (and task states) at the given frames of a dataset.

    Args:
      method: whose action space to use.
      task: whose state's points are scaled, and whose arms' trocars may be drawn elsewhere.
      dataset: the demonstrations, wherever they are.
      frames: `[n]` frame numbers, those trained on.
    """

    wrist = wrist_of(method, task)

    @jax.jit
    def encode_commands(command, trocar):
        pose, gripper, angles = command
        return encode(method.action_space, pose, gripper, trocar, wrist, angles)

    actions = windows.over_frames(dataset, frames, lambda _, *rest: encode_commands(*rest))
    space = rcm.action_space(method.action_space, wrist)
    action = _min_max(actions, entries_but(space, task.arms, "R"))
    if not space.is_absolute:
        action = action.replace(reach=_reach(action, space, task, dataset, frames, wrist))
    state = None
    if dataset.observation.state is not None:
        states = windows.over_frames(dataset, frames, lambda observation, *_: observation.state)
        state = _min_max(states, _points(task.fields))
    return Normalizer(action=action, state=state)


def shapes(method: methods.Method, task: Task, state: bool) -> Normalizer:
    """Returns the structure of `fit`'s result, with or without the task state."""
    space = rcm.action_space(method.action_space, wrist_of(method, task))
    size = task.arms * (space.dim + 1)
    ends = [jax.ShapeDtypeStruct((n,), jnp.float32) for n in (size, task.state_size)]
    reach = jax.ShapeDtypeStruct((2, size), jnp.float32)
    action = MinMax(ends[0], ends[0], None if space.is_absolute else reach)
    return Normalizer(action, MinMax(ends[1], ends[1]) if state else None)


def keeps_to_manifold(method: methods.Method) -> bool:
    """Returns True if executed poses are on the RCM manifold."""
    return method.projects or not rcm.ACTION_SPACES.registry.get(method.action_space).is_free


def has_wrist(method: methods.Method) -> bool:
    """Returns True if a method commands wrist angles, which a tool with a wrist is needed for."""
    return rcm.ACTION_SPACES.registry.get(method.action_space).for_wrist is not None


def wrist_of(method: methods.Method, task: Task) -> rcm.Wrist | None:
    """Returns the wrist that a method commands, None for a method of straight wrists.

    Raises:
      errors.UsageError: it commands angles, and the task's tools have no wrist or different ones.
    """
    if not has_wrist(method):
        return None
    wrist = wrists.common(task)
    if wrist is None:
        tools = " ".join(slot.tool for slot in task.slots)
        expected = f"with one kind of wrist, for a method of {method.label or 'wrists'}"
        raise errors.UsageError("tool", f"tools {expected}", tools)
    return wrist


def _reach(
    box: MinMax,
    space: rcm.ActionSpace,
    task: Task,
    dataset: windows.Dataset,
    frames: np.ndarray,
    wrist: rcm.Wrist | None,
) -> jax.Array:
    """Returns the scaled range `[2, A * (dim + 1)]` that reaches demonstrated tips.

    The tips are encoded through extreme trocars: the highest, lowest and outermost ones of Eq. 19
    about each arm's nominal trocar, and the centre, where {T} turns too.
    """
    around = np.linspace(*rcm.AZIMUTH_RANGE, _EDGE_AZIMUTHS, endpoint=False)
    heights = [*rcm.POLAR_RANGE, np.mean(rcm.POLAR_RANGE)]
    trocars = rcm.Trocar(*(x.ravel() for x in np.meshgrid(rcm.RADIUS_RANGE, heights, around)))
    p_world_ref = np.array([slot.p_world_ref for slot in task.slots], np.float32)
    roll_zero = np.array([slot.roll_zero for slot in task.slots], np.float32)

    @jax.jit
    def ends(command):
        def through(trocar):
            frame = rcm.trocar_frame(trocar, p_world_ref, roll_zero)
            # The same tip through another trocar
            if wrist is None:
                pose = rcm.project(command.pose, frame.p_world_trocar)
            else:
                pose = rcm.through(wrist, command.pose, frame.p_world_trocar).pose
            scaled = box.normalize(encode(space.name, pose, command.gripper, frame, wrist))
            return scaled.min(axis=0), scaled.max(axis=0)

        low, high = jax.vmap(through)(trocars)
        return jnp.concatenate([low, high])

    # 1. range of each entry over all frames, through every extreme trocar
    edge = windows.over_frames(dataset, frames, lambda _, command, __: ends(command))
    # 2. union with [-1, 1]; rotations, rolls and wrists keep that range, whatever the trocar
    reach = np.stack([np.full(edge.shape[-1], -1.0), np.full(edge.shape[-1], 1.0)])
    counted = entries_but(space, task.arms, "R", "roll", "wrist")
    # Relative coordinates of one tip differ by trocar: samples clipped to the training's box
    # could not reach it through an unseen one.
    reach[0, counted] = np.minimum(edge[:, counted].min(axis=0), -1.0)
    reach[1, counted] = np.maximum(edge[:, counted].max(axis=0), 1.0)
    return jnp.asarray(reach, jnp.float32)


def entries_but(space: rcm.ActionSpace, arms: int, *names: str) -> np.ndarray:
    """Returns the indices of all parts of the arms' actions except those of these names."""
    parts = [part for name, part in space.slices.items() if name not in names]
    of_one = np.concatenate([np.arange(part.start, part.stop) for part in parts])
    first = np.arange(arms) * (space.dim + 1)  # each arm's part of the vector ends with its jaws
    return (first[:, None] + of_one).ravel()


def _points(fields: tuple[Field, ...]) -> np.ndarray:
    """Returns the indices of points in the task state."""
    is_point = np.repeat([field.kind == "point" for field in fields], [f.size for f in fields])
    return np.flatnonzero(is_point)


def _min_max(values: np.ndarray, scaled: np.ndarray) -> MinMax:
    if not np.isfinite(values).all():
        raise ValueError("dataset: expected finite poses and states, got NaN or infinity")
    low, high = values.min(axis=0), values.max(axis=0)
    # a constant entry is centred and keeps its unit's scale, so that noise on it is not blown up
    constant = high - low < _SMALLEST_RANGE
    middle = 0.5 * (low + high)
    low, high = np.where(constant, middle - 1.0, low), np.where(constant, middle + 1.0, high)
    # Rotations: within [-1, 1], their columns of unit length
    unchanged = np.ones(values.shape[-1], bool)
    unchanged[scaled] = False
    low, high = np.where(unchanged, -1.0, low), np.where(unchanged, 1.0, high)
    return MinMax(jnp.asarray(low, jnp.float32), jnp.asarray(high, jnp.float32))
