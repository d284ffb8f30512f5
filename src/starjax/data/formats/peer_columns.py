"""Columns, splits and texts of an export that other tools expect, derived from starjax's fields."""

from typing import Any

import numpy as np
from scipy.spatial import transform

from starjax import rcm
from starjax.data import schema, store
from starjax.data.formats import base
from starjax.data.formats.base import Column
from starjax.rollouts import episodes

_AXES = ("x", "y", "z", "qx", "qy", "qz", "qw", "gripper")


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


def columns(description: dict[str, Any]) -> dict[str, Column]:
    """Returns the columns that other tools expect, derived from starjax's fields."""
    arms = len(description["p_world_ref"])
    names = [f"arm{i}_{axis}" if arms > 1 else axis for i in range(arms) for axis in _AXES]
    places = [
        name.replace("gripper", "") for name in names if name[-1] in "xyz" and "q" not in name
    ]
    found = {
        "state": Column((8 * arms,), "float32", tuple(names)),
        "action": Column((8 * arms,), "float32", tuple(names)),
        "trocar": Column((3 * arms,), "float32", tuple(places)),
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
    arrays: dict[str, np.ndarray], record: store.Record, description: dict[str, Any]
) -> dict[str, np.ndarray]:
    """Returns the columns of an episode."""
    length, places = record["length"], schema.trocars_of([record])
    reference = np.asarray(description["p_world_ref"], np.float32)
    trocar = np.asarray(rcm.trocar_position(places, reference)).reshape(1, -1)
    last = np.arange(length) == length - 1
    rows = {
        "state": _poses(arrays["p"], arrays["R"], arrays["gripper"]),
        "action": _poses(arrays["command_p"], arrays["command_R"], arrays["command_gripper"]),
        "trocar": np.repeat(trocar, length, axis=0).astype(np.float32),
        "reward": (last & record["success"]).astype(np.float32),
        "done": last,
    }
    return rows | ({"environment_state": arrays["state"]} if "state" in arrays else {})


def _poses(p: np.ndarray, R: np.ndarray, gripper: np.ndarray) -> np.ndarray:
    """Packs positions, continuous quaternions xyzw and grippers to `[T, 8 A]`."""
    turned = transform.Rotation.from_matrix(R.reshape(-1, 3, 3)).as_quat()
    turned = turned.reshape(*R.shape[:2], 4)
    # q and -q are one rotation: keep the one nearer to the previous step.
    ahead = np.where(np.sum(turned[1:] * turned[:-1], -1, keepdims=True) < 0, -1.0, 1.0)
    turned[1:] *= np.cumprod(ahead, axis=0)
    rows = np.concatenate([p, turned, gripper[..., None]], -1)
    return rows.reshape(len(p), -1).astype(np.float32)
