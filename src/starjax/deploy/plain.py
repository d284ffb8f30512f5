"""Plain frames of openpi: observations by name in, `actions [H, 8 A]` out.

A row has, for each arm, the tip's x y z in m, its quaternion x y z w and the gripper's opening,
-1 closed to 1 open, all in the world frame: the columns of `starjax export --format lerobot`.
`observation/trocar` is the trocar's x y z in m, in the same frame.
"""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from starjax import rcm
from starjax.deploy.inputs import InputSpec, RobotObservation, image_of, trocar_position
from starjax.errors import UsageError
from starjax.types import Command, Pose

COLUMNS = 8  # of an arm
MAX_HORIZON = 4096
MAX_NORM_ERROR = 0.1  # of a measured quaternion: beyond, the columns are others
_SHORTEST = 0.5  # norm of a quaternion: below, its direction is noise


def encode(
    spec: InputSpec, prompt: str, observation: RobotObservation, trocar: rcm.Trocar
) -> dict[str, Any]:
    """Collects the arrays of a request; of the observation `[1]` its latest moment."""
    R, p, gripper = (np.asarray(x)[-1] for x in (*observation.pose, observation.gripper))
    xyzw = Rotation.from_matrix(R.reshape(-1, 3, 3)).as_quat().reshape(*R.shape[:-2], 4)
    row = np.concatenate([p, xyzw, gripper[..., None]], -1).astype(np.float32)
    request = {
        "observation/state": row.reshape(-1),
        "observation/trocar": trocar_position(trocar, spec.p_world_ref).astype(np.float32).ravel(),
        "prompt": prompt,
    }
    for name in spec.cameras:
        field = "image" if len(spec.cameras) == 1 else name
        request[f"observation/{field}"] = np.asarray(image_of(observation, name))[-1]
    if not spec.cameras:
        request["observation/environment_state"] = np.asarray(observation.state, np.float32)[-1]
    return request


def decode(spec: InputSpec, value: Any) -> Command:
    """Reads the plan `[H, *arms]` of an answer.

    Raises:
      UsageError: there are no `actions`, or they have another shape or invalid values.
    """
    actions = value.get("actions") if isinstance(value, dict) else None
    width = COLUMNS * (spec.arms[0] if spec.arms else 1)
    if not isinstance(actions, np.ndarray) or actions.dtype.kind not in "fiu":
        raise UsageError("answer.actions", "an array of numbers", type(actions).__name__)
    if actions.ndim != 2 or actions.shape[1] != width or not 1 <= len(actions) <= MAX_HORIZON:
        expected = f"shape [H, {width}] with H of at most {MAX_HORIZON}"
        raise UsageError("answer.actions", expected, list(actions.shape))
    if not np.isfinite(actions).all():
        raise UsageError("answer.actions", "finite values", "NaN or inf")
    rows = actions.astype(np.float64).reshape(len(actions), *spec.arms, COLUMNS)
    p, xyzw, gripper = rows[..., :3], rows[..., 3:7], rows[..., 7]
    if (norm := np.linalg.norm(xyzw, axis=-1)).min() < _SHORTEST:
        raise UsageError("answer.actions", "unit quaternions x y z w", f"one of norm {norm.min()}")
    R = Rotation.from_quat(xyzw.reshape(-1, 4)).as_matrix().reshape(*p.shape, 3)
    leaves: Any = (R, p, np.clip(gripper, -1.0, 1.0))  # numpy arrays, as a server's answer is
    R, p, gripper = (leaf.astype(np.float32) for leaf in leaves)
    return Command(Pose(R, p), gripper)
