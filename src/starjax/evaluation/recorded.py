"""Trajectories of a few trials, for figures and the video."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from starjax import rcm
from starjax.core.types import Pose
from starjax.runtime import files
from starjax.sim.rollouts.episodes import ENDOSCOPE, Episode

# One trajectory a configuration is recorded for figures, unless there are more than this.
FIGURE_TROCARS = 16

_LABEL = "labels."
_BY_STEP = ("p_world_tip", "rcm_error", "qpos", *ENDOSCOPE)
_COLUMNS = ("trocar", "trial", "length", "p_world_trocar", "p_world_tip", "rcm_error", "qpos")


class Trajectory(NamedTuple):
    """One recorded trial of T control steps; poses and joints are those after each step.

    Attributes:
      trocar: index of the configuration.
      trial: number at this configuration.
      p_world_tip: `[T, A, 3]` m.
      p_world_trocar: `[A, 3]` m.
      rcm_error: `[T, A]` m, executed, or None where the file does not have it.
      qpos: `[T, Q]` generalised coordinates, or None.
      labels: the task's, e.g. source and target.
      endoscope: pose_world_camera `[T]`, or None where the scene was not seen through one.
    """

    trocar: int
    trial: int
    p_world_tip: np.ndarray
    p_world_trocar: np.ndarray
    rcm_error: np.ndarray | None
    qpos: np.ndarray | None
    labels: dict[str, int]
    endoscope: Pose | None = None


def choose(count: int, trials: int, video_trials: int) -> np.ndarray:
    """Selects the recorded trials, as a mask `[count * trials]`: first trials of trocars first."""
    if not video_trials:
        return np.zeros(count * trials, bool)
    wanted = min(max(video_trials, count if count <= FIGURE_TROCARS else 0), count * trials)
    first = np.arange(wanted)
    if wanted < count:  # spread over the trocars
        trocar, trial = np.linspace(0, count - 1, wanted).round().astype(int), 0 * first
    else:
        trial, trocar = np.divmod(first, count)
    mask = np.zeros((count, trials), bool)
    mask[trocar, trial] = True
    return mask.reshape(-1)


def names(labels: Sequence[str], has_endoscope: bool = False) -> list[str]:
    """Returns the names of the columns of `take` for trials with these labels."""
    more = ENDOSCOPE if has_endoscope else ()
    return [*_COLUMNS, *more, *(f"{_LABEL}{name}" for name in labels)]


def take(episodes: Sequence[Episode], p_world_ref: np.ndarray) -> dict[str, np.ndarray]:
    """Returns columns of R recorded trials, NaN after the end of each.

    Args:
      episodes: recorded as `episodes.SCORE` says.
      p_world_ref: `[A, 3]` m.
    """
    if not episodes:
        return {}
    outcomes = [episode.outcome for episode in episodes]
    trocar = rcm.Trocar(
        *(np.array([o[name] for o in outcomes], np.float32) for name in rcm.Trocar._fields)
    )
    return {
        "trocar": np.array([o["trocar"] for o in outcomes], np.int32),
        "trial": np.array([o["trial"] for o in outcomes], np.int32),
        "length": np.array([o["length"] for o in outcomes], np.int32),
        "p_world_tip": _padded([episode.joined("reached_p") for episode in episodes]),
        "rcm_error": _padded([episode.joined("rcm_error") for episode in episodes]),
        "qpos": _padded([episode.joined("reached_qpos") for episode in episodes]),
        "p_world_trocar": np.asarray(rcm.trocar_position(trocar, p_world_ref)),
        **{
            name: _padded([episode.joined(name) for episode in episodes])
            for name in ENDOSCOPE
            if name in episodes[0].arrays
        },
        **{
            f"{_LABEL}{name}": np.array([o["labels"][name] for o in outcomes], np.int32)
            for name in outcomes[0]["labels"]
        },
    }


def join(kept: Sequence[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Joins the columns of all chunks that have recorded trials."""
    kept = [part for part in kept if part]
    joined = {}
    for name in kept[0]:
        parts = [part[name] for part in kept]
        rows = _padded([row for part in parts for row in part]) if name in _BY_STEP else None
        joined[name] = np.concatenate(parts) if rows is None else rows
    return joined


def read(file: Path) -> list[Trajectory]:
    """Reads the trials of a recorded.npz.

    Raises:
      FileNotFoundError: the file is missing.
      ValueError: the file is damaged; the message names it.
    """
    always = ("trocar", "trial", "length", "p_world_tip", "p_world_trocar")
    found = files.read_npz(file, always)
    if found["p_world_tip"].ndim != 4:
        raise ValueError(f"{file}: expected tips [N, T, A, 3], got an older file; evaluate again")
    return [_row(found, row, int(length)) for row, length in enumerate(found["length"])]


def _row(found: dict[str, np.ndarray], row: int, length: int) -> Trajectory:
    def steps(name: str) -> Any:
        return found[name][row, :length] if name in found else None

    labels = {name: int(x[row]) for name, x in found.items() if name.startswith(_LABEL)}
    return Trajectory(
        trocar=int(found["trocar"][row]),
        trial=int(found["trial"][row]),
        p_world_tip=steps("p_world_tip"),
        p_world_trocar=found["p_world_trocar"][row],
        rcm_error=steps("rcm_error"),
        qpos=steps("qpos"),
        labels={name.removeprefix(_LABEL): value for name, value in labels.items()},
        endoscope=Pose(*map(steps, ENDOSCOPE)) if ENDOSCOPE[0] in found else None,
    )


def _padded(rows: Sequence[np.ndarray]) -> np.ndarray:
    """Pads rows `[T, ...]` of different lengths with NaN to one array."""
    longest = max(1, *map(len, rows))
    found = np.full((len(rows), longest, *rows[0].shape[1:]), np.nan, np.float32)
    for out, row in zip(found, rows, strict=True):
        out[: len(row)] = row
    return found
