"""Anomalies of demonstrations: damage, jumps, values that are not finite, wrong trocars."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from starjax import rcm
from starjax.data import schema, shafts, store
from starjax.runtime import files
from starjax.sim.rollouts import episodes

FAST = 1.0  # m/s; faster tips are jumps
MISSED = 1e-3  # m; shafts farther from the trocar are not on its manifold
MOVED = 2e-3  # m; between the recorded trocar and the estimated one
SURE = 5e-4  # m; estimates with a larger standard deviation are ignored
SHORT = 16  # control steps; shorter episodes are less than a plan


def find(root: Path) -> Iterator[str]:
    """Yields one line per kind of anomaly of a starjax dataset, damage first.

    Raises:
      ValueError: `root` is not a dataset.
    """
    about = store.read_description(root)
    try:
        store.read_seal(root)
    except ValueError as error:
        yield str(error)
    found: dict[str, list[str]] = {}
    for key, record in store.verify_all(root, store.keys(root)).items():
        if isinstance(record, store.DamagedEpisode):
            yield str(record)
        elif record["files"]:
            for kind, detail in _of_episode(root, about, record):
                found.setdefault(kind, []).append(f"{key}{f' ({detail})' if detail else ''}")
    for kind, where in found.items():
        more = f" and {len(where) - 1} more" if len(where) > 1 else ""
        yield f"{kind}: {where[0]}{more}"
    yield from import_notes(root)


def import_notes(root: Path) -> list[str]:
    """Reads the notes of `starjax import` on the imported files."""
    path = root / schema.IMPORTED
    return files.read_json(path).get("notes", []) if path.exists() else []


def _of_episode(
    root: Path, about: Mapping[str, Any], record: Mapping[str, Any]
) -> Iterator[tuple[str, str]]:
    """Yields (kind, detail) of each anomaly."""
    if record["length"] < SHORT:
        yield f"shorter than {SHORT} control steps", str(record["length"])
    folder = root / "episodes" / record["key"]
    arrays = {
        name: np.load(folder / f"{name}.npy", mmap_mode="r", allow_pickle=False)
        for name in about["features"]
        if f"{name}.npy" in record["files"]
    }
    for name, array in arrays.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            yield f"{name} is not finite", ""
            if name in ("p", "R"):
                return
        if name.startswith(episodes.IMAGE) and array.size and array.min() == array.max():
            yield f"{name} is of one colour", ""
    R: Any = arrays["R"]
    p: Any = arrays["p"]
    # Tips of an instrument with a wrist say nothing about the trocar; its shafts do.
    pose = rcm.Pose(arrays.get("shaft_R", R), arrays.get("shaft_p", p))
    speed = np.linalg.norm(np.diff(arrays["p"], axis=0), axis=-1) * about["control_hz"]
    if speed.size and speed.max() > FAST:
        yield f"tips faster than {FAST:g} m/s", f"{speed.max():.2g} m/s"
    told = rcm.trocar_position(
        schema.trocars_of([record]), np.array(about["p_world_ref"], np.float32)
    )[0]
    missed = float(np.max(rcm.rcm_error(pose, told)))
    if missed > MISSED:
        yield f"shafts pass the trocar at more than {1e3 * MISSED:g} mm", f"{1e3 * missed:.2g} mm"
    seen = shafts.estimate(pose.R, pose.p)
    deviation = np.sqrt(np.linalg.eigvalsh(np.asarray(seen.covariance))[:, -1])
    is_sure = np.asarray(seen.is_determined) & (deviation < SURE)
    away = np.linalg.norm(np.asarray(seen.p_world_trocar) - np.asarray(told), axis=-1)
    if (is_sure & (away > MOVED)).any():
        yield (
            "the motion shows another trocar than the recorded one",
            f"{1e3 * away[is_sure].max():.2g} mm",
        )
    rolls = np.asarray(rcm.roll_of(pose.R)) - np.array(about["roll_zero"])
    turned = np.abs(np.diff(np.mod(rolls + np.pi, 2 * np.pi), axis=0))
    if turned.size and turned.max() > np.pi:
        yield "rolls pass half a turn, where an action's roll wraps", ""
