"""Monitors with and without compensation for delays, on the same trials.

    python benchmarks/monitor_shift.py POLICY TRACES.npz STILL_S

TRACES.npz is of monitor_traces.py. One monitor has the scores of new calibrations, the other those
of the first version (disagreement and clock instead of conflict and progress); both are calibrated
with the same sampled trials. Every second point of a plan is recorded: the others are
interpolated.
"""

import sys
from types import SimpleNamespace
from typing import Any

import _timing
import monitor_traces
import numpy as np

from starjax.evaluation import alarms
from starjax.monitor import calibrate, scores
from starjax.sim.tasks.base import CONTROL_HZ

FIRST = ("disagreement", "stillness", "clock", "closure")
ALPHA = 0.05


def main(policy: str, file: str, still_s: str) -> None:
    """Writes results/monitor_shift_<policy>_cpu.json."""
    with np.load(file) as arrays:
        labels = [name.removesuffix("/lengths") for name in arrays if name.endswith("/lengths")]
        execute = int(arrays["execute"])
    still = round(float(still_s) * CONTROL_HZ / execute)
    settings = scores.ScoreSettings(execute, CONTROL_HZ, still)
    tables = {label: scored(file, label, settings) for label in labels}
    sampled = tables.pop("sampled")
    fits, calibrates, _ = calibrate.parts(len(sampled.success))
    parts = [sampled.scores[sampled.success & part] for part in (fits, calibrates)]
    results: dict[str, Any] = {}
    for which, names in (("first", FIRST), ("new", scores.CALIBRATED)):
        monitor = calibrate.calibrate(*parts, ALPHA, settings, names=names)
        for label, table in tables.items():
            found = alarms.compose(table, monitor)
            kept = {name: found[name] for name in ("before_clock", "announced", "false_alarms")}
            results.setdefault(which, {"count": monitor.count})[label] = kept
    _timing.report(f"monitor_shift_{policy}", {"results": results}, tiny=False)


def scored(file: str, label: str, settings: scores.ScoreSettings) -> Any:
    """Returns columns and scores of a set of trials."""
    columns, decisions = monitor_traces.read(file, label)
    found = np.full((*decisions.shape[:2], len(scores.NAMES)), np.nan)
    for row, trial in zip(found, decisions, strict=True):
        known = trial[np.isfinite(trial).all(axis=(1, 2))]
        planned, ahead = plans(known, settings.execute)
        steps = np.repeat(np.arange(len(known)), settings.execute)
        points = known[..., :-2].reshape(*known.shape[:2], -1, 3)
        tip = points[:, :, -monitor_traces.TIPS]  # the first measured one
        values = scores.of_trial(planned, ahead, tip[steps], known[steps, :, -2], settings)
        row[: len(values)] = values
    return SimpleNamespace(scores=found, **columns)


def plans(known: np.ndarray, execute: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns planned tips `[T, A, 3]` of all control steps, and those of `execute` steps later."""
    points = known[..., :-2].reshape(*known.shape[:2], -1, 3)[:, :, : -monitor_traces.TIPS]
    after = 2 * points[:, :, -1:] - points[:, :, -2:-1]  # one more point, on the last line
    ends = np.concatenate([points, after], axis=2)
    middles = (ends[:, :, 1:] + ends[:, :, :-1]) / 2
    whole = np.stack([ends[:, :, :-1], middles], axis=3).reshape(*points.shape[:2], -1, 3)
    whole = np.moveaxis(whole, 2, 1)  # [D, H, A, 3]
    parts = whole[:, :execute], whole[:, execute : 2 * execute]
    return tuple(part.reshape(-1, *part.shape[2:]) for part in parts)


if __name__ == "__main__":
    if len(sys.argv) != 4:
        sys.exit(__doc__)
    main(*sys.argv[1:])
