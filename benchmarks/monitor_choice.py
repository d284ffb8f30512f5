"""Monitor of a packaged policy: scores, rate of false alarms and window by a rule, and its test.

    python benchmarks/monitor_choice.py POLICY TRIALS.npz

TRIALS.npz is of monitor_trials.py. Every second trocar of the task chooses, of `ALPHAS` and
`WINDOWS`, the monitor that meets both goals under the most disturbances; among equals, the one
that misses them by least. The other trocars, and the last sampled ones, test it. Writes
results/monitor_<POLICY>_gpu.json, with the same for every one of `ATTEMPTS`. `PACKAGED` names
those of the packaged monitors.
"""

import json
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import monitors
import numpy as np

from starjax.addons.finetune import calibration
from starjax.evaluation import alarms
from starjax.policies import packaged, policy_file
from starjax.policies.monitor import record, scores
from starjax.runtime import files

EARLY, FALSE = 0.9, 0.1  # goals: failures announced before the clock, false alarms
ALPHAS = (0.01, 0.02, 0.03, 0.05)
WINDOWS = (1, 2, 3)  # multiples of the recorded window of stillness
TROCARS = 12  # scores of every task
FIRST = ("disagreement", "stillness", "clock", "closure")
FIRST_SCORES, NEW_SCORES = "first scores", "new scores"
PACKAGED = {"compact": FIRST_SCORES}  # scores of the others: the new ones
_HELD = 3  # decisions
_LEAST = 0.25  # progress per time, of a divisor
_STILLNESS, _CLOSURE, _PROGRESS = map(scores.NAMES.index, ("stillness", "closure", "progress"))


class Attempt(NamedTuple):
    """A way to make a monitor.

    Attributes:
      names: scores that raise alarms.
      change: (scores `[M, D, S]`, settings) -> scores.
      calibrated: as `monitors.calibrated`.
    """

    names: tuple[str, ...] = scores.CALIBRATED
    change: Callable[[np.ndarray, scores.ScoreSettings], np.ndarray] = lambda values, _: values
    calibrated: Callable[..., record.Monitor] = monitors.calibrated


class Chosen(NamedTuple):
    """A monitor, with the trials that it scores."""

    trials: monitors.Trials
    monitor: record.Monitor


def main(policy: str, file: str) -> None:
    """Chooses and tests all attempts; writes the results."""
    arrays = files.read_npz(Path(file))
    path = packaged.find("policy", policy)
    weights = json.loads(arrays["monitor.json"].tobytes())["weights"]
    if weights != files.sha256(path):
        sys.exit(f"{file}: expected trials of {path}, got those of weights {weights[:8]}")
    digest = policy_file.monitor_digest(policy_file.load(path).params)
    outcomes = {}
    for name, attempt in ATTEMPTS.items():
        best = choose(arrays, attempt, digest)
        settings = best.monitor.settings
        outcomes[name] = {
            "alpha": best.monitor.alpha,
            "still_s": settings.still_s,
            "chosen": pairs(halved(best.trials.labels, is_test=False), best.monitor),
            "tested": pairs(halved(best.trials.labels, is_test=True), best.monitor),
        }
        print(name, outcomes[name])
        if name == PACKAGED.get(policy, NEW_SCORES):
            trials, monitor = best
            strict = attempt.calibrated(
                trials.whole, monitors.STRICT, settings, digest, attempt.names
            )
            labels = halved(trials.labels, is_test=True)
            tested = {monitors.TESTED: trials.labels[monitors.TESTED], **labels}
            kept = (policy, arrays, tested, monitor, strict)
    monitors.write(*kept, attempts=outcomes)


def choose(arrays: dict[str, np.ndarray], attempt: Attempt, digest: str) -> Chosen:
    """Returns the monitor of an attempt that is best at the choosing trocars."""

    def rank(found: Chosen) -> tuple[int, float]:
        met = pairs(halved(found.trials.labels, is_test=False), found.monitor)
        return met["both"], -met["short"]

    def candidates():
        for windows in WINDOWS:
            trials = monitors.read(arrays, windows)
            for table in (trials.whole, *trials.labels.values()):
                table.scores = attempt.change(table.scores, trials.settings)
            for alpha in ALPHAS:
                which = (alpha, trials.settings, digest, attempt.names)
                yield Chosen(trials, attempt.calibrated(trials.whole, *which))

    return max(candidates(), key=rank)


def halved(labels: Mapping[str, Any], *, is_test: bool) -> dict[str, Any]:
    """Returns the tables at every second trocar of the task, from the first or the second."""
    halves = {}
    for label, table in labels.items():
        if label != monitors.TESTED:
            trocar = np.arange(len(table.success)) * TROCARS // len(table.success)
            halves[label] = monitors.select(table, trocar % 2 == is_test)
    return halves


def pairs(labels: Mapping[str, Any], monitor: record.Monitor) -> dict[str, Any]:
    """Counts the disturbances under which the goals are met, and by how much they are missed."""
    counts = {"pairs": 0, "early": 0, "false": 0, "both": 0, "short": 0.0}
    for label, table in labels.items():
        if label == monitors.UNDISTURBED:
            continue
        found = alarms.compose(table, monitor)
        early, false = (found[name]["rate"] for name in ("before_clock", "false_alarms"))
        is_early, is_quiet = (early or 0.0) >= EARLY, false is not None and false <= FALSE
        short = max(0.0, EARLY - (early or 0.0)) + max(0.0, (false or 0.0) - FALSE)
        for name, value in zip(counts, (1, is_early, is_quiet, is_early and is_quiet, short)):
            counts[name] += value
    return counts


def by_progress(values: np.ndarray, settings: scores.ScoreSettings) -> np.ndarray:
    """Divides the path of the tip by the progress of the plans per time, over the same window."""
    changed, still = values.copy(), settings.still
    rate = np.full(values.shape[:2], np.nan)
    rate[:, still:] = values[:, still:, _PROGRESS] - values[:, :-still, _PROGRESS]
    changed[..., _STILLNESS] /= np.maximum(rate / settings.still_s, _LEAST)
    return changed


def held(values: np.ndarray, settings: scores.ScoreSettings) -> np.ndarray:
    """Returns scores whose closure is the smallest of three successive decisions."""
    del settings
    changed, closure = values.copy(), values[..., _CLOSURE]
    windows = np.lib.stride_tricks.sliding_window_view(closure, _HELD, axis=1)
    changed[:, _HELD - 1 :, _CLOSURE] = windows.min(axis=-1)
    changed[:, : _HELD - 1, _CLOSURE] = np.nan
    return changed


def by_score(
    table: Any,
    alpha: float,
    settings: scores.ScoreSettings,
    digest: str,
    names: tuple[str, ...],
) -> record.Monitor:
    """Calibrates each score alone at its part of alpha (Bonferroni), without a common scale."""
    monitor = monitors.calibrated(table, alpha, settings, digest, names)
    fits, calibrates, _ = calibration.parts(len(table.success))
    values = table.scores[table.success & (fits | calibrates)]
    limits = np.full(len(scores.NAMES), np.nan)
    for name in names:
        i = scores.NAMES.index(name)
        largest = calibration.maxima(values[..., i : i + 1], np.zeros(1), np.ones(1))
        limits[i] = calibration.threshold(largest, alpha / len(names))
    return monitor._replace(center=limits - 1.0, width=np.ones(len(limits)), threshold=1.0)


ATTEMPTS = {
    FIRST_SCORES: Attempt(FIRST),
    NEW_SCORES: Attempt(),
    "levels of scores": Attempt(calibrated=by_score),
    "path by progress": Attempt(change=by_progress),
    "jaws closed for three decisions": Attempt(change=held),
}


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main(*sys.argv[1:])
