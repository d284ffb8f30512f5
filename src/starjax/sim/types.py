"""What a policy may see of the simulation. Structs only, so that data and policies need no MJX."""

import flax.struct
import jax

from starjax.types import Pose


@flax.struct.dataclass
class Observation:
    """One measured moment of an episode.

    Attributes:
      pose: measured tip pose in the world frame, `[...]`.
      gripper: measured opening of the jaws, `[...]` in [-1 closed, +1 open].
      image: camera picture, `[..., h, w, 3]` uint8, or None where pixels are not observed.
      state: task state in place of pixels, `[..., 12]`, or None: block position (3) m, the block's
        6-D rotation (6), target peg position (3) m, all in the world frame.
      features: what a frozen vision encoder sees in the picture, `[..., d_v]` float32, in the
        place of the picture; only in the data that such a policy is trained on.
    """

    pose: Pose
    gripper: jax.Array
    image: jax.Array | None = None
    state: jax.Array | None = None
    features: jax.Array | None = None
