"""Figures of the exercise with six blocks, and those of people for comparison."""

from typing import Any

import numpy as np

from starjax.addons.six_blocks.task import BLOCKS, LIMIT_S
from starjax.evaluation import statistics
from starjax.evaluation import trials as tables

# Figures of FLS: six blocks there and back, without one dropped out of view.
PEOPLE = {"ways": 2, "proficient_s": 48.0, "residents_s": 84.0, "limit_s": LIMIT_S}


def compose(table: tables.Table, control_hz: float) -> dict[str, Any]:
    """Computes figures of trials of `environment` as JSON values.

    Returns:
      {complete: {successes, trials, rate, ci95}, moved: {mean, counts `[7]` of trials by blocks},
      dropped, collided, invalid: numbers of trials, seconds: {median, p90} of complete ones or
      None, blocks, ways: of a whole trial, rcm_error_mm: as in result.json, people: PEOPLE}.
    """
    moved, seconds = table.labels["moved"], table.steps[table.success] / control_hz
    return {
        "blocks": BLOCKS,
        "ways": 1,
        "complete": statistics.rate(table.success),
        "moved": {
            "mean": float(moved.mean()),
            "counts": np.bincount(moved, minlength=BLOCKS + 1).tolist(),
        },
        "dropped": int(table.lost.sum()),
        "collided": int(table.collided.sum()),
        "invalid": int(table.invalid.sum()),
        "seconds": {"median": float(np.median(seconds)), "p90": float(np.quantile(seconds, 0.9))}
        if len(seconds)
        else None,
        "rcm_error_mm": statistics.rcm_error_mm(table),
        "people": PEOPLE,
    }
