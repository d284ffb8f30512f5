"""Statistics of an evaluation, and the part of result.json that they are.

Written by `compose`, figures in SI units unless the name says otherwise, intervals are 95%:

    method, observation   names
    seen, unseen          {successes, trials, rate, ci95 [low, high]}: strict success; Wilson
    generalization_gap    rate seen - rate unseen (Eq. 20); generalization_gap_ci95: Newcombe
    strict, loose, safe   {seen, unseen, all}, each as above; safe: strict, and the executed RCM
                          error never above safe_rcm_mm, within control steps too
    per_trocar            list of {trocar, radius, polar, azimuth: lists [A], seen} and strict
                          success as above
    rcm_error_mm          {commanded {max}, executed {mean, p99, max, p99_of_successes},
                          within_steps {p99, max, p99_of_successes}}: executed at the ends of
                          all control steps of all trials (a failed one has many, up to the time
                          limit), or of the strictly successful ones; within_steps: the largest
                          at the physics steps of each control step
    steps                 {mean, median} control steps of the strictly successful trials
    invalid, collided     number of trials
    trials                list of `result.Trial`s, radius, polar and azimuth lists [A]

Rates and intervals are null without trials, the quantile of successes without a success.
"""

import math
from typing import Any

import numpy as np
import scipy.stats

from starjax.evaluation import trials as tables

CONFIDENCE = 0.95


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """Computes Wilson's score interval of a success rate.

    (p + z^2/2n ± z sqrt(p(1-p)/n + z^2/4n^2)) / (1 + z^2/n), with z = 1.96 for 95%.
    """
    if not 0 <= successes <= trials or trials < 1:
        raise ValueError(
            "successes, trials: expected 0 <= successes <= trials and trials > 0, "
            f"got {successes}, {trials}"
        )
    interval = scipy.stats.binomtest(successes, trials).proportion_ci(CONFIDENCE, "wilson")
    return float(interval.low), float(interval.high)


def rate(success: np.ndarray) -> dict[str, Any]:
    """Counts successes `[M]` bool: {successes, trials, rate, ci95}."""
    successes, trials = int(np.sum(success)), len(success)
    if not trials:
        return {"successes": 0, "trials": 0, "rate": None, "ci95": None}
    return {
        "successes": successes,
        "trials": trials,
        "rate": successes / trials,
        "ci95": list(wilson(successes, trials)),
    }


def generalization_gap(seen: np.ndarray, unseen: np.ndarray) -> tuple[float, tuple[float, float]]:
    """Computes SR_seen - SR_unseen (Eq. 20) of successes `[M]` bool, with Newcombe's interval.

    Newcombe's hybrid score method (1998, no. 10) combines the two Wilson intervals [l, u]:
    gap - sqrt((a - l_a)^2 + (u_b - b)^2) to gap + sqrt((u_a - a)^2 + (b - l_b)^2).
    """
    a, b = rate(seen), rate(unseen)
    if a["rate"] is None or b["rate"] is None:
        raise ValueError(f"seen, unseen: expected trials of both, got {len(seen)}, {len(unseen)}")
    gap = a["rate"] - b["rate"]
    low = gap - math.hypot(a["rate"] - a["ci95"][0], b["ci95"][1] - b["rate"])
    high = gap + math.hypot(a["ci95"][1] - a["rate"], b["rate"] - b["ci95"][0])
    return gap, (low, high)


def mcnemar(a: np.ndarray, b: np.ndarray) -> dict[str, Any]:
    """Computes McNemar's exact test of two methods on the same trials, `[M]` bool each.

    Under the null hypothesis, trials that one method alone solved are binomial with p = 1/2.

    Returns:
      {only_a, only_b, p_value}: trials that one alone solved, and the two-sided p value.
    """
    a, b = np.asarray(a, bool), np.asarray(b, bool)
    if a.shape != b.shape:
        raise ValueError(f"a, b: expected outcomes of the same trials, got {a.shape}, {b.shape}")
    only_a, only_b = int(np.sum(a & ~b)), int(np.sum(b & ~a))
    differing = only_a + only_b
    p = scipy.stats.binomtest(only_a, differing).pvalue if differing else 1.0
    return {"only_a": only_a, "only_b": only_b, "p_value": float(p)}


def rcm_error_mm(table: tables.Table) -> dict[str, Any]:
    """Computes rcm_error_mm, as documented at the top of this file."""
    # The mean and the maximum come from float32 figures: float16 is for the quantile only.
    mean = np.sum(table.rcm_mean * table.steps.astype(np.float64)) / max(np.sum(table.steps), 1)
    return {
        "commanded": {"max": 1e3 * _max(table.rcm_commanded_max)},
        "executed": {
            "mean": 1e3 * float(mean),
            **_worst(table, "rcm_error_mm", table.rcm_max),
        },
        "within_steps": _worst(table, "rcm_within_mm", table.rcm_within_max),
    }


def _worst(table: tables.Table, column: str, largest: np.ndarray) -> dict[str, float | None]:
    """Computes percentiles and maximum of a per-step column; `largest` `[M]` m is per trial."""
    return {
        "p99": _p99(getattr(table, column)),
        "max": 1e3 * _max(largest),
        "p99_of_successes": _p99(getattr(tables.select(table, table.success), column)),
    }


def _p99(errors: np.ndarray) -> float | None:
    return float(np.quantile(errors.astype(np.float64), 0.99)) if errors.size else None


def compose(
    table: tables.Table, is_seen: np.ndarray, *, method: str, observation: str, seed: int
) -> dict[str, Any]:
    """Computes the figures of an evaluation, as documented at the top of this file.

    Args:
      table: all trials.
      is_seen: `[C]` bool, whether a trocar was trained on.
      method: its name.
      observation: "image" or "state".
      seed: of the evaluation.
    """
    seen = np.asarray(is_seen, bool)[table.trocar]
    outcomes = {"strict": table.success, "loose": table.loose, "safe": table.safe}
    gap, interval = None, None
    if seen.any() and not seen.all():
        gap, interval = generalization_gap(table.success[seen], table.success[~seen])
    taken = table.steps[table.success]
    return {
        "method": method,
        "observation": observation,
        "seen": rate(table.success[seen]),
        "unseen": rate(table.success[~seen]),
        "generalization_gap": gap,
        "generalization_gap_ci95": list(interval) if interval else None,
        **{
            name: {
                "seen": rate(outcome[seen]),
                "unseen": rate(outcome[~seen]),
                "all": rate(outcome),
            }
            for name, outcome in outcomes.items()
        },
        "safe_rcm_mm": 1e3 * tables.SAFE_RCM_M,
        "per_trocar": _per_trocar(table, seen),
        "rcm_error_mm": rcm_error_mm(table),
        "steps": {
            "mean": float(taken.mean()) if taken.size else None,
            "median": float(np.median(taken)) if taken.size else None,
        },
        "invalid": int(table.invalid.sum()),
        "collided": int(table.collided.sum()),
        "trials": trials(table, seen, seed),
    }


def trials(table: tables.Table, seen: np.ndarray, seed: int) -> list[dict[str, Any]]:
    """Returns one JSON record per trial; `seen` `[M]` bool."""
    fields = (
        "trocar", "radius", "polar", "azimuth", "trial", "success", "loose", "safe", "invalid",
        "collided", "lost", "steps", "stage",
    )  # fmt: skip
    columns = {name: getattr(table, name).tolist() for name in fields}
    for name in ("rcm_max", "rcm_within_max", "rcm_commanded_max"):
        columns[f"{name}_mm"] = (1e3 * getattr(table, name).astype(np.float64)).tolist()
    columns["seen"] = np.asarray(seen, bool).tolist()
    labels = {name: values.tolist() for name, values in table.labels.items()}
    return [
        {
            **{name: values[row] for name, values in columns.items()},
            "labels": {name: values[row] for name, values in labels.items()},
            "seed": seed,
        }
        for row in range(len(table.trocar))
    ]


def _per_trocar(table: tables.Table, seen: np.ndarray) -> list[dict[str, Any]]:
    found = []
    for trocar in np.unique(table.trocar):
        rows = table.trocar == trocar
        first = int(np.argmax(rows))
        found.append(
            {
                "trocar": int(trocar),
                "radius": table.radius[first].tolist(),
                "polar": table.polar[first].tolist(),
                "azimuth": table.azimuth[first].tolist(),
                "seen": bool(seen[first]),
                **rate(table.success[rows]),
            }
        )
    return found


def _max(values: np.ndarray) -> float:
    return float(values.max(initial=0.0))
