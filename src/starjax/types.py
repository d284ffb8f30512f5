"""The two structs that every layer shares: a pose and a command. Imports jax only."""

from typing import NamedTuple

import jax


class Pose(NamedTuple):
    """A rigid pose; the frames are in the variable's name, e.g. `pose_world_tip`.

    Attributes:
      R: `[..., 3, 3]` rotation matrix; its third column is the tool's axis, distal, its second the
        direction in which the jaws open.
      p: `[..., 3]` position of the tip (jaw centre) in m.
    """

    R: jax.Array
    p: jax.Array


class Command(NamedTuple):
    """What the environment is asked to reach by the end of one control step.

    Attributes:
      pose: tip pose in the world frame, `[...]`.
      gripper: `[...]` in [-1, 1]: -1 squeezes, +1 is fully open.
    """

    pose: Pose
    gripper: jax.Array
