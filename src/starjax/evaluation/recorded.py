"""Trajectories of a few trials, for figures and the video: which ones, and what of them."""

from collections.abc import Sequence

import jax
import numpy as np

from starjax import rcm
from starjax.rollouts import engine

# One trajectory a trocar is recorded for figures, unless there are more trocars than this.
FIGURE_TROCARS = 16


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
