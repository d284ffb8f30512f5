"""Motions of a dataset's episodes, with figures: trocar, RCM error, reach, speed, wrist, jaws."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from starjax.data import schema, shafts, store
from starjax.rcm.trocar import trocar_position

MAX_EPISODES = 50  # for a dataset whose motions are read
_WINDOW_S = 5.0  # s, of the motion by which a trocar's wander is estimated
_MAX_WINDOWS = 6  # for an episode, evenly spaced
_CLOSED = 0.0  # for a gripper in [-1, 1], below which it counts as closed


class EpisodeMotion(NamedTuple):
    """The motion of one episode with A arms.

    Attributes:
      number: of the episode in the files.
      hz: control steps per second.
      R: `[T, A, 3, 3]` R_world_shaft; that of the tip for a straight tool.
      p_shaft: `[T, A, 3]` m, a point on the shaft.
      p: `[T, A, 3]` m, tips.
      R_tip: `[T, A, 3, 3]` R_world_tip, or None for straight tools.
      gripper: `[T, A]` in [-1, 1].
      p_world_trocar: `[A, 3]` m.
      success: False for failures.
      split: names of its splits.
    """

    number: int
    hz: float
    R: np.ndarray
    p_shaft: np.ndarray
    p: np.ndarray
    gripper: np.ndarray
    p_world_trocar: np.ndarray
    success: bool
    split: str
    R_tip: np.ndarray | None = None


class MotionFigures(NamedTuple):
    """Figures of one arm in one episode.

    Attributes:
      rcm_mm: `[T]` distance of the shaft from the trocar.
      depth_mm: `[T]` of the tip below the trocar, along the shaft.
      speed_mm_s: `[T - 1]` of the tip.
      gripper: `[T]` in [-1, 1].
      wander_mm: `[W]` distances of the trocars of single windows from that of the episode; only
        windows that determine theirs.
      closings: of the jaws.
      bend_deg: `[T, 2]` pitch and yaw of the wrist, or None for a straight tool.
    """

    rcm_mm: np.ndarray
    depth_mm: np.ndarray
    speed_mm_s: np.ndarray
    gripper: np.ndarray
    wander_mm: np.ndarray
    closings: int
    bend_deg: np.ndarray | None = None


def figures(recording: EpisodeMotion, arm: int) -> MotionFigures:
    """Computes the figures of an arm."""
    R, trocar = recording.R[:, arm], recording.p_world_trocar[arm]
    off = np.cross(recording.p_shaft[:, arm] - trocar, R[..., 2])
    tips = recording.p[:, arm]
    is_closed = recording.gripper[:, arm] < _CLOSED
    return MotionFigures(
        rcm_mm=1e3 * np.linalg.norm(off, axis=-1),
        depth_mm=1e3 * np.sum((tips - trocar) * R[..., 2], -1),
        speed_mm_s=1e3 * np.linalg.norm(np.diff(tips, axis=0), axis=-1) * recording.hz,
        gripper=recording.gripper[:, arm],
        wander_mm=_wander(recording, arm),
        closings=int(np.sum(is_closed[1:] & ~is_closed[:-1])),
        bend_deg=None if recording.R_tip is None else _bend(R, recording.R_tip[:, arm]),
    )


def _bend(R_world_shaft: np.ndarray, R_world_tip: np.ndarray) -> np.ndarray:
    """Returns pitch and yaw `[T, 2]` degrees of R_shaft_tip `[T, 3, 3]` = Ry(pitch) Rx(yaw)."""
    R = np.swapaxes(R_world_shaft, -1, -2) @ R_world_tip
    pitch = np.arctan2(-R[:, 2, 0], R[:, 0, 0])
    return np.rad2deg(np.stack([pitch, np.arctan2(-R[:, 1, 2], R[:, 1, 1])], -1))


def _wander(recording: EpisodeMotion, arm: int) -> np.ndarray:
    rows = round(_WINDOW_S * recording.hz)
    count = min(_MAX_WINDOWS, len(recording.p) // max(rows, 1))
    found = []
    for first in np.linspace(0, len(recording.p) - rows, count).astype(int):
        window = slice(first, first + rows), slice(arm, arm + 1)
        estimate = shafts.estimate(recording.R[window], recording.p_shaft[window])
        if estimate.is_determined[0]:
            away = np.asarray(estimate.p_world_trocar[0]) - recording.p_world_trocar[arm]
            found.append(1e3 * np.linalg.norm(away))
    return np.array(found)


def of_dataset(root: Path) -> Iterator[EpisodeMotion]:
    """Reads the first episodes of a starjax dataset that have files."""
    about = store.read_description(root)
    reference = np.array(about["p_world_ref"], np.float32)
    records = store.verify_all(root, store.keys(root), arrays=False).values()
    kept = [r for r in records if isinstance(r, dict) and r["files"]]
    for i, record in enumerate(kept[:MAX_EPISODES]):
        folder = root / "episodes" / record["key"]
        has_wrist = "shaft_R.npy" in record["files"]
        shaft = ("shaft_R", "shaft_p") if has_wrist else ("R", "p")
        R, p, gripper, R_shaft, p_shaft = (
            np.load(folder / f"{name}.npy", allow_pickle=False).astype(np.float64)
            for name in ("R", "p", "gripper", *shaft)
        )
        yield EpisodeMotion(
            record.get("episode", i),
            about["control_hz"],
            R_shaft,
            p_shaft,
            p,
            gripper,
            np.asarray(trocar_position(schema.trocars_of([record]), reference)[0], np.float64),
            bool(record["success"]),
            ", ".join(record.get("splits", [])),
            R if has_wrist else None,
        )


def spread(values: np.ndarray) -> tuple[float, float]:
    """Returns the median and the 99th percentile; NaN of nothing."""
    if not len(values):
        return math.nan, math.nan
    median, high = np.percentile(values, [50, 99])
    return float(median), float(high)
