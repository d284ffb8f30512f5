"""Columns, splits and texts of an export that other tools expect, derived from starjax's fields."""

from typing import Any, NamedTuple

import numpy as np

from starjax import rcm
from starjax.addons.formats import base
from starjax.addons.formats.base import Column
from starjax.core import errors
from starjax.data import pose_rows, schema, store
from starjax.sim.rollouts import episodes

_AXES = ("x", "y", "z", "qx", "qy", "qz", "qw", "gripper")
_RCM4_AXES = ("roll", "x", "y", "z", "gripper")
_LENGTHS = 64  # episodes are filled up to a multiple of it


class PeerOptions(NamedTuple):
    """Columns for readers that look at `state` and `action` only.

    Attributes:
      state_with_trocar: append the trocars to `state`.
      actions: key of `ACTIONS`: poses, or roll in rad and tip on the RCM manifold of the trocar.
    """

    state_with_trocar: bool = False
    actions: str = "pose"


DEFAULT = PeerOptions()


def splits(records: list[store.Record]) -> dict[str, range]:
    """Returns the spans of successes and of failures that follow them."""
    count = sum(bool(record["success"]) for record in records)
    failures = {"failure": range(count, len(records))} if count < len(records) else {}
    return {"train": range(count)} | failures


def texts(scene: dict[str, Any]) -> dict[str, list[str]]:
    """Returns the task and the tools under Open-H's names."""
    tools = {
        f"observation.meta.tool.arm{i}" if len(scene["tools"]) > 1 else "observation.meta.tool": [t]
        for i, t in enumerate(scene["tools"])
    }
    return {"instruction.text": [scene["task"].replace("_", " ")]} | tools


def name_of(field: str) -> str:
    """Returns the name of the column that holds a field as it is."""
    return field if field.startswith(episodes.IMAGE) else f"{base.OURS}.{field}"


def columns(description: dict[str, Any], options: PeerOptions = DEFAULT) -> dict[str, Column]:
    """Returns the columns that other tools expect, derived from starjax's fields.

    Raises:
      errors.UsageError: actions of straight tools for a dataset with a wrist.
    """
    if options.actions != "pose" and "wrist" in description["features"]:
        tools = " ".join(description["scene"]["tools"])
        hint = "a wrist follows from the pose and the trocar"
        raise errors.UsageError("actions", f"pose, for {tools}", options.actions, hint)
    arms = len(description["p_world_ref"])

    def named(axes: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(f"arm{i}_{axis}" if arms > 1 else axis for i in range(arms) for axis in axes)

    states, places = named(_AXES), named(_AXES[:3])
    if options.state_with_trocar:
        states += named(tuple(f"trocar_{axis}" for axis in _AXES[:3]))
    actions = named(_AXES if options.actions == "pose" else _RCM4_AXES)
    found = {
        "state": Column((len(states),), "float32", states),
        "action": Column((len(actions),), "float32", actions),
        "trocar": Column((3 * arms,), "float32", places),
        "reward": Column((), "float32"),
        "done": Column((), "bool"),
    }
    if "state" in description["features"]:
        count = description["features"]["state"]["shape"]
        fields = description.get("task", {}).get("fields", [])
        labels = tuple(f"{name}.{i}" for name, size, *_ in fields for i in range(size))
        found["environment_state"] = Column(tuple(count), "float32", labels)
    return found


def derived(
    arrays: dict[str, np.ndarray],
    record: store.Record,
    description: dict[str, Any],
    options: PeerOptions = DEFAULT,
) -> dict[str, np.ndarray]:
    """Returns the columns of an episode."""
    length, places = record["length"], schema.trocars_of([record])
    reference = np.asarray(description["p_world_ref"], np.float32)
    trocar = np.asarray(rcm.trocar_position(places, reference)).reshape(1, -1)
    trocar = np.repeat(trocar, length, axis=0).astype(np.float32)
    last = np.arange(length) == length - 1
    state = _poses(arrays["p"], arrays["R"], arrays["gripper"])
    command = arrays["command_p"], arrays["command_R"], arrays["command_gripper"]
    frame = rcm.trocar_frame(places, reference, np.float32(description["roll_zero"]))
    rows = {
        "state": np.concatenate([state, trocar], -1) if options.state_with_trocar else state,
        "action": _poses(*command) if options.actions == "pose" else _rcm4(*command, frame),
        "trocar": trocar,
        "reward": (last & record["success"]).astype(np.float32),
        "done": last,
    }
    return rows | ({"environment_state": arrays["state"]} if "state" in arrays else {})


def _rcm4(p: np.ndarray, R: np.ndarray, gripper: np.ndarray, frame: rcm.TrocarFrame) -> np.ndarray:
    """Returns continuous rolls, tips and grippers `[T, 5 A]`."""
    encode = rcm.ACTION_SPACES["rcm4"].encode
    # Programs are compiled for a length: episodes of similar ones share them.
    filled = np.minimum(np.arange(-(-len(p) // _LENGTHS) * _LENGTHS), len(p) - 1)
    pose: Any = (R.astype(np.float32)[filled], p.astype(np.float32)[filled])
    rows = np.array(encode(rcm.Pose(*pose), frame))[: len(p)]
    rows[..., 0] = np.unwrap(rows[..., 0], axis=0)
    return np.concatenate([rows, gripper[..., None]], -1).reshape(len(p), -1).astype(np.float32)


def _poses(p: np.ndarray, R: np.ndarray, gripper: np.ndarray) -> np.ndarray:
    """Packs positions, continuous quaternions and grippers to `[T, 8 A]`."""
    rows = pose_rows.pack(p, R, gripper)
    for step in range(1, len(rows)):
        rows[step] = pose_rows.without_flips(rows[step], rows[step - 1])
    return rows.astype(np.float32)
