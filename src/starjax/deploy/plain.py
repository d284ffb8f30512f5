"""Plain frames of openpi: observations by name in, `actions [H, 8 A]` out.

A row has, for each arm, the tip's x y z in m, its quaternion x y z w and the gripper's opening,
-1 closed to 1 open, all in the world frame: the columns of `starjax export --format lerobot`.
`observation/trocar` is the trocar's x y z in m, in the same frame. A server whose greeting has the
`action_space` rcm4 answers `[H, 5 A]`: roll in rad, x y z in m and opening, on the RCM manifold.
"""

from typing import Any

import jax
import numpy as np

from starjax import rcm
from starjax.core import config
from starjax.core.errors import UsageError
from starjax.core.types import Command, Pose
from starjax.data import pose_rows
from starjax.deploy.inputs import InputSpec, RobotObservation, image_of, trocar_position
from starjax.sim import env as sim_env
from starjax.sim.task import Task

MAX_HORIZON = 4096


def input_spec(env: sim_env.Env, settings: config.PolicyConfig) -> InputSpec:
    """Returns the inputs of a policy of plain frames in an environment."""
    p_world_ref = np.asarray(env.p_world_ref, np.float32)
    arms = () if len(p_world_ref) == 1 else (len(p_world_ref),)
    return InputSpec(
        moments=1,
        arms=arms,
        p_world_ref=p_world_ref if arms else p_world_ref[0],
        keeps_to_manifold=False,
        image_size=settings.image_size,
        cameras=env.names.cameras if settings.observation == "image" else (),
        state_size=env.task.state_size,
    )


def encode(
    spec: InputSpec,
    prompt: str,
    observation: RobotObservation,
    trocar: rcm.Trocar,
    key: jax.Array | None = None,
) -> dict[str, Any]:
    """Collects the arrays of a request; of the observation `[1]` its latest moment.

    Plain requests have no random `key`.
    """
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


def decode(
    spec: InputSpec, action_space: str, task: Task, value: Any, trocar: rcm.Trocar
) -> Command:
    """Reads the plan `[H, *arms]` of an answer.

    Args:
      spec: inputs of the policy.
      action_space: key of `pose_rows.ACTIONS`.
      task: of the scene.
      value: the answer.
      trocar: measured trocars `[*arms]` of the request.

    Raises:
      UsageError: there are no `actions`, or they have another shape or invalid values.
    """
    actions = value.get("actions") if isinstance(value, dict) else None
    arms = spec.arms[0] if spec.arms else 1
    width = pose_rows.ACTIONS[action_space] * arms
    if not isinstance(actions, np.ndarray) or actions.dtype.kind not in "fiu":
        raise UsageError("answer.actions", "an array of numbers", type(actions).__name__)
    if actions.ndim != 2 or actions.shape[1] != width or not 1 <= len(actions) <= MAX_HORIZON:
        expected = f"shape [H, {width}] with H of at most {MAX_HORIZON}"
        raise UsageError("answer.actions", expected, list(actions.shape))
    if not np.isfinite(actions).all():
        raise UsageError("answer.actions", "finite values", "NaN or inf")
    if action_space == "pose":
        p, R, gripper = pose_rows.unpack("answer.actions", actions)
    else:
        p, R, gripper = _on_manifold(actions.reshape(len(actions), arms, -1), task, trocar)
    leaves: Any = (R, p, np.clip(gripper, -1.0, 1.0))  # numpy arrays, as a server's answer is
    if not spec.arms:
        leaves = tuple(leaf[:, 0] for leaf in leaves)
    R, p, gripper = (leaf.astype(np.float32) for leaf in leaves)
    return Command(Pose(R, p), gripper)


def _on_manifold(rows: np.ndarray, task: Task, trocar: rcm.Trocar) -> tuple[np.ndarray, ...]:
    """Returns positions, rotations and grippers of rows `[H, A, 5]`."""
    reference = np.array([slot.p_world_ref for slot in task.slots], np.float32)
    roll_zero = np.array([slot.roll_zero for slot in task.slots], np.float32)
    fields = (np.reshape(field, (len(reference),)) for field in trocar)
    frame = rcm.trocar_frame(rcm.Trocar(*fields), reference, roll_zero)
    decode_rows = rcm.ACTION_SPACES["rcm4"].decode
    pose, _ = decode_rows(rows[..., :-1].astype(np.float32), frame)
    return np.asarray(pose.p), np.asarray(pose.R), rows[..., -1]
