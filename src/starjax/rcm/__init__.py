"""Action spaces on the remote-centre-of-motion manifold of a laparoscopic tool. Needs jax only.

>>> action_space = rcm.ACTION_SPACES["rcm4"]
>>> pose, valid = action_space.decode(action, trocar, p_world_ref)
"""

from starjax.core.types import Pose
from starjax.rcm.actions import ACTION_SPACES, MAX_REACH, ActionSpace
from starjax.rcm.estimate import (
    MAX_RESIDUAL,
    MIN_SPREAD,
    TrocarEstimate,
    trocar_from_poses,
    why_undetermined,
)
from starjax.rcm.manifold import (
    HOLD_DEPTH,
    MAX_DEPTH,
    MIN_DEPTH,
    insertion_depth,
    pose_at_depth,
    pose_on_manifold,
    project,
    rcm_error,
)
from starjax.rcm.rotations import (
    roll_of,
    rot6d_decode,
    rot6d_encode,
    rotation_align,
    rotation_from_axis_roll,
    rotation_z,
)
from starjax.rcm.trocar import (
    AZIMUTH_RANGE,
    IS_SEEN,
    POLAR_RANGE,
    POLAR_RANGE_WIDE,
    RADIUS_RANGE,
    TROCARS,
    Trocar,
    TrocarFrame,
    check_trocar,
    sample_trocar,
    trocar_frame,
    trocar_from_position,
    trocar_position,
    trocar_rotation,
)
from starjax.rcm.wrist import (
    LARGE_NEEDLE_DRIVER,
    PROGRASP,
    Wrist,
    WristPose,
    angles_through,
    shaft_of,
    through,
    tip_of,
)
from starjax.rcm.wrist_actions import action_space, rcm6, se3_through, se3_wrist

__all__ = [
    "ACTION_SPACES",
    "AZIMUTH_RANGE",
    "HOLD_DEPTH",
    "IS_SEEN",
    "LARGE_NEEDLE_DRIVER",
    "MAX_DEPTH",
    "MAX_REACH",
    "MAX_RESIDUAL",
    "MIN_DEPTH",
    "MIN_SPREAD",
    "POLAR_RANGE",
    "POLAR_RANGE_WIDE",
    "PROGRASP",
    "RADIUS_RANGE",
    "TROCARS",
    "ActionSpace",
    "Pose",
    "Trocar",
    "TrocarEstimate",
    "TrocarFrame",
    "Wrist",
    "WristPose",
    "action_space",
    "angles_through",
    "check_trocar",
    "insertion_depth",
    "pose_at_depth",
    "pose_on_manifold",
    "project",
    "rcm6",
    "rcm_error",
    "roll_of",
    "rot6d_decode",
    "rot6d_encode",
    "rotation_align",
    "rotation_from_axis_roll",
    "rotation_z",
    "sample_trocar",
    "se3_through",
    "se3_wrist",
    "shaft_of",
    "through",
    "tip_of",
    "trocar_frame",
    "trocar_from_poses",
    "trocar_from_position",
    "trocar_position",
    "trocar_rotation",
    "why_undetermined",
]
