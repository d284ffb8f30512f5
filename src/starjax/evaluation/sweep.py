"""Other trocars than the twelve: grids and samples, and success against distance to training's."""

from typing import Any

import jax
import numpy as np
from jax.typing import ArrayLike

from starjax import rcm
from starjax.core import errors
from starjax.evaluation import statistics
from starjax.evaluation import trials as tables
from starjax.rcm.trocar import Trocar
from starjax.sim import sampling
from starjax.sim.task import Task

BIN_WIDTH = 0.01  # m, of the distance to the nearest training trocar


def sample(seed: int, count: int, task: Task) -> Trocar:
    """Draws configurations as in Eq. 19, each arm in its workspace's ranges: fields `[count, A]`.

    The ranges of the workspace `board` are section V-A2's.
    """
    if count < 1:
        raise errors.UsageError("count", "1 or more", count)
    return Trocar(*map(np.asarray, sampling.sample_trocars(jax.random.key(seed), task, (count,))))


def grid(radii: np.ndarray, polars: np.ndarray, azimuths: np.ndarray, arms: int = 1) -> Trocar:
    """Combines all radii (m), polar angles and azimuths (rad): `[C, arms]`.

    All arms have the same one, each about its own nominal trocar. Positions that coincide (at
    radius 0, and at polar angles 0 and pi) appear once.
    """
    fields = (np.asarray(x, np.float32).reshape(-1) for x in (radii, polars, azimuths))
    combined = np.stack(np.meshgrid(*fields, indexing="ij"), -1).reshape(-1, 3)
    trocars = rcm.check_trocar(Trocar(*combined.T))
    places = np.asarray(rcm.trocar_position(trocars, np.zeros(3, np.float32)))
    _, first = np.unique(places.round(6), axis=0, return_index=True)
    return Trocar(*(np.tile(x[:, None], arms) for x in combined[np.sort(first)].T))


def distance_to_nearest(trocars: Trocar, training: Trocar, p_world_ref: np.ndarray) -> np.ndarray:
    """Returns the distance `[C]` in m of each configuration to the nearest one of training.

    Between two configurations it is that of the arm whose trocars are farthest apart.

    Args:
      trocars: fields `[C, A]`. training: fields `[K, A]`. p_world_ref: `[A, 3]` m.
    """
    here = np.asarray(rcm.trocar_position(trocars, p_world_ref))
    there = np.asarray(rcm.trocar_position(training, p_world_ref))
    apart = np.linalg.norm(here[:, None] - there[None], axis=-1)
    return apart.max(axis=-1).min(axis=1)


def bin_of(distance: ArrayLike) -> np.ndarray:
    """Returns the bin of `BIN_WIDTH` of each distance (m), in float64 as results are read back."""
    return np.floor(np.asarray(distance, np.float64) / BIN_WIDTH).astype(int)


def compose(
    table: tables.Table, training: Trocar, p_world_ref: np.ndarray, *, seed: int
) -> dict[str, Any]:
    """Computes a sweep's result as JSON values: figures overall, by distance, and all trials.

    Args:
      table: trials at any trocars.
      training: fields `[K, A]`, the trocars trained on.
      p_world_ref: `[A, 3]` m.
      seed: of the trials.

    Returns:
      {strict, loose, safe: as in result.json, by_distance: list of {low_m, high_m, successes,
      trials, rate, ci95}, rcm_error_mm, trials: as in result.json, with distance_m}.
    """
    trocars = Trocar(table.radius, table.polar, table.azimuth)
    distance = distance_to_nearest(trocars, training, p_world_ref)
    bins = bin_of(distance)
    seen = distance < 1e-6
    trials = statistics.trials(table, seen, seed)
    return {
        "strict": statistics.rate(table.success),
        "loose": statistics.rate(table.loose),
        "safe": statistics.rate(table.safe),
        "by_distance": [
            {
                "low_m": float(b * BIN_WIDTH),
                "high_m": float((b + 1) * BIN_WIDTH),
                **statistics.rate(table.success[bins == b]),
            }
            for b in np.unique(bins)
        ],
        "rcm_error_mm": statistics.rcm_error_mm(table),
        "trials": [
            {**trial, "distance_m": d} for trial, d in zip(trials, distance.tolist(), strict=True)
        ],
    }
