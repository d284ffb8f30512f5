"""Bodies that the draws of an episode put at rest, `Task.still`, in the C model."""

import mujoco
import numpy as np

from starjax.core.types import Pose


def place(m: mujoco.MjModel, data: mujoco.MjData, still: Pose | None) -> None:
    """Puts `still0`, .. of C data at their poses `[K]`, for the next kinematics."""
    if still is None:
        return
    for i, (R, p) in enumerate(zip(np.asarray(still.R, float), still.p)):
        row = m.body(f"still{i}").mocapid[0]
        data.mocap_pos[row] = p
        mujoco.mju_mat2Quat(data.mocap_quat[row], R.ravel())
