"""The structs that every layer shares. Imports jax and numpy only.

Shape letter A: arms. It is the last leading axis wherever arrays have one shape for all arms; a
task of one arm has A = 1.
"""

from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple, TypeAlias, TypeVar

import jax
import numpy as np

Array = jax.Array | np.ndarray
ArrayTree: TypeAlias = Array | Iterable["ArrayTree"] | Mapping[Any, "ArrayTree"]
Tree = TypeVar("Tree")  # a pytree that a function maps leaf by leaf


class Pose(NamedTuple):
    """A rigid pose; the frames are in the variable's name, e.g. `pose_world_tip`.

    Attributes:
      R: `[..., 3, 3]` rotation matrix; its third column is the axis of the tool, distal (with a
        wrist that of the jaws), its second the direction in which the jaws open.
      p: `[..., 3]` position of the tip (jaw centre) in m.
    """

    R: jax.Array
    p: jax.Array


class Command(NamedTuple):
    """Target of the environment for the end of one control step.

    Attributes:
      pose: tip poses in the world frame, `[..., A]`.
      gripper: `[..., A]` in [-1, 1]: -1 squeezes, +1 is fully open.
      wrist: `[..., A, 2]` rad, pitch and yaw; None for straight tools and straight wrists. They say
        how the commanded shaft lies: the agent finds them through the trocar that it was given.
    """

    pose: Pose
    gripper: jax.Array
    wrist: jax.Array | None = None


class Observation(NamedTuple):
    """One measured moment of an episode.

    Attributes:
      pose: measured tip poses in the world frame, `[..., A]`.
      gripper: measured openings of the jaws, `[..., A]` in [-1 closed, +1 open].
      images: camera's name -> `[..., h, w, 3]` uint8, or None where pixels are not observed.
      state: the task's fields instead of pixels, `[..., S]`, or None.
      features: outputs of a frozen image encoder, `[..., d_v]` float32, in place of the images;
        only in training data.
      wrist: measured pitch and yaw, `[..., A, 2]` rad; None in a scene without a wrist.
      endoscope: pose_world_camera `[...]` of an endoscope that is elsewhere in every episode, x to
        the right, y up, looking along -z; None where the scene is not seen through one.
    """

    pose: Pose
    gripper: jax.Array
    images: dict[str, jax.Array] | None = None
    state: jax.Array | None = None
    features: jax.Array | None = None
    endoscope: Pose | None = None
    wrist: jax.Array | None = None


class Agent(NamedTuple):
    """An agent in an environment, as pure functions of one episode.

    Attributes:
      init: (key, EnvState) -> memory.
      act: (memory, EnvState) -> (Command `[A]` to execute, memory, Command `[A]` to record). The
        last is the target of imitation: an expert that disturbs itself records the undisturbed
        command, others the executed one.
    """

    init: Callable[..., Any]
    act: Callable[..., Any]
