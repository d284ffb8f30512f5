"""Plain frames of openpi: observations by name in, `actions [H, 8 A]` out.

A row has, for each arm, the tip's x y z in m, its quaternion x y z w and the gripper's opening,
-1 closed to 1 open, all in the world frame: the columns of `starjax export --format lerobot`.
`observation/trocar` is the trocar's x y z in m, in the same frame.
"""

from typing import Any

import numpy as np

from starjax import rcm
from starjax.data import pose_rows
from starjax.deploy.inputs import InputSpec, RobotObservation, image_of, trocar_position
from starjax.errors import UsageError
from starjax.types import Command, Pose

MAX_HORIZON = 4096


def encode(
    spec: InputSpec, prompt: str, observation: RobotObservation, trocar: rcm.Trocar
) -> dict[str, Any]:
    """Collects the arrays of a request; of the observation `[1]` its latest moment."""
    R, p, gripper = (np.asarray(x)[-1] for x in (*observation.pose, observation.gripper))
    if not spec.arms:
        R, p, gripper = R[None], p[None], gripper[None]
    request = {
        "observation/state": pose_rows.pack(p, R, gripper).astype(np.float32),
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
    width = pose_rows.COLUMNS * (spec.arms[0] if spec.arms else 1)
    if not isinstance(actions, np.ndarray) or actions.dtype.kind not in "fiu":
        raise UsageError("answer.actions", "an array of numbers", type(actions).__name__)
    if actions.ndim != 2 or actions.shape[1] != width or not 1 <= len(actions) <= MAX_HORIZON:
        expected = f"shape [H, {width}] with H of at most {MAX_HORIZON}"
        raise UsageError("answer.actions", expected, list(actions.shape))
    p, R, gripper = pose_rows.unpack("answer.actions", actions)
    leaves: Any = (R, p, np.clip(gripper, -1.0, 1.0))  # numpy arrays, as a server's answer is
    if not spec.arms:
        leaves = tuple(leaf[:, 0] for leaf in leaves)
    R, p, gripper = (leaf.astype(np.float32) for leaf in leaves)
    return Command(Pose(R, p), gripper)
