"""Trajectories of a few trials, for figures and the video: which ones, and what of them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from starjax import rcm
from starjax.rollouts import engine
from starjax.runtime import files

# One trajectory a trocar is recorded for figures, unless there are more trocars than this.
FIGURE_TROCARS = 16

_LABEL = "labels."
_PEGS = ("source", "target")


class Trajectory(NamedTuple):
    """One recorded trial of T control steps; poses and joints are those after each step.

    Attributes:
      trocar, trial: which one.
      p_world_tip: `[T, A, 3]` m.
      p_world_trocar: `[A, 3]` m.
      rcm_error: `[T, A]` m, executed, or None where the file does not have it.
      qpos: `[T, Q]` generalised coordinates, or None.
      labels: the task's, e.g. source and target.
    """

    trocar: int
    trial: int
    p_world_tip: np.ndarray
    p_world_trocar: np.ndarray
    rcm_error: np.ndarray | None
    qpos: np.ndarray | None
    labels: dict[str, int]


def choose(count: int, trials: int, video_trials: int) -> np.ndarray:
    """Which of the `[count * trials]` trials are recorded: the first of every trocar, and so on."""
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


def take(
    done: engine.Rollouts, here: engine.Trials, chosen: np.ndarray, p_world_ref: np.ndarray
) -> dict[str, np.ndarray]:
    """Recorded trials R of a chunk, `[R, T]`, each meaningful up to its `length`."""
    rows = np.flatnonzero(chosen)
    trocar = jax.tree.map(lambda x: x[rows], done.env.trocar)
    steps = max(int(done.length[rows].max(initial=1)), 1)
    return {
        "trocar": here.index[rows],
        "trial": here.trial[rows],
        "length": done.length[rows],
        "p_world_tip": np.moveaxis(done.steps.p_world_tip[:steps, rows], 0, 1),
        "rcm_error": np.moveaxis(done.steps.rcm_error[:steps, rows], 0, 1),
        "qpos": np.moveaxis(done.steps.qpos[:steps, rows], 0, 1),
        "p_world_trocar": np.asarray(rcm.trocar_position(trocar, p_world_ref)),
        "source_peg": done.env.source[rows],
        "target_peg": done.env.target[rows],
    }


def join(kept: Sequence[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Trajectories of all chunks, NaN after each trial's end."""
    length = np.concatenate([part["length"] for part in kept])
    longest = int(length.max())
    joined = {}
    for name in kept[0]:
        parts = [part[name] for part in kept]
        if name in ("p_world_tip", "rcm_error", "qpos"):
            shape = (len(length), longest, *parts[0].shape[2:])
            rows = (row for part in parts for row in part)
            joined[name] = np.full(shape, np.nan, np.float32)
            for out, n, row in zip(joined[name], length, rows, strict=True):
                out[:n] = row[:n]
        else:
            joined[name] = np.concatenate(parts)
    return joined


def read(file: Path) -> list[Trajectory]:
    """The trials in a recorded.npz, also one of before the axis of arms.

    Raises:
      FileNotFoundError: there is none.
      ValueError: the file is damaged; the message names it.
    """
    names = ("trocar", "trial", "length", "p_world_tip", "p_world_trocar")
    found = files.read_npz(file, names)
    if found["p_world_tip"].ndim == 3:
        for name in ("p_world_tip", "p_world_trocar", "rcm_error"):
            if name in found:
                found[name] = np.expand_dims(found[name], 1 if name == "p_world_trocar" else 2)
        found |= {f"{_LABEL}{n}": found[f"{n}_peg"] for n in _PEGS if f"{n}_peg" in found}
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
    )
