"""Runtime monitors of the packaged policies: their trials, their results, their place in the files.

    python benchmarks/monitors.py silent POLICY STILL_S OUT.safetensors
    python benchmarks/monitors.py gather OUT.npz CALIBRATION STRESS
    python benchmarks/monitors.py score POLICY TRIALS.npz [ALPHA WINDOWS SCORES...]
    python benchmarks/monitors.py insert POLICY

`silent` writes a policy whose monitor never raises an alarm: its evaluations record scores before
a calibration has ended. `gather` joins directories of `starjax calibrate` and `starjax stress`: of
every evaluation the columns below, as `<evaluation>/<column>`, and the commands' JSON files.
`score` calibrates a monitor from such a file, at a rate of false alarms and with stillness over so
many of the recorded windows, and writes results/monitor_<POLICY>_gpu.json; `insert` puts the
monitor of these results next to the packaged file. Neither needs a GPU.
"""

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import _timing
import numpy as np

from starjax.addons.finetune import calibration
from starjax.evaluation import alarms, statistics
from starjax.policies import packaged, policy_file
from starjax.policies.monitor import record, scores
from starjax.runtime import files
from starjax.sim.task import CONTROL_HZ
from starjax.tasks.peg_transfer_bimanual.task import DROPPED_STEPS

COLUMNS = ("success", "lost", "invalid", "steps", "scores")
TESTED, UNDISTURBED = "nothing, trocars of the test", "nothing, the task's trocars"
_NEVER = 1e9  # a threshold beyond any score
STRICT = 0.01  # a second rate of false alarms
_OPEN = 0.3  # opening in [-1, 1]: wider than around any object


def silent(policy: str, still_s: str, out: str) -> None:
    """Writes a policy with a monitor that never raises an alarm."""
    trained = policy_file.load(packaged.find("policy", policy))
    execute = trained.policy.execute
    still = max(1, round(float(still_s) * CONTROL_HZ / execute))
    monitor = record.Monitor(
        center=np.zeros(len(scores.NAMES)),
        width=np.ones(len(scores.NAMES)),
        threshold=_NEVER,
        clock_s=_NEVER,
        alpha=0.0,
        count=0,
        settings=scores.ScoreSettings(execute, CONTROL_HZ, still),
        digest=policy_file.monitor_digest(trained.params),
    )
    half = policy_file.is_half(trained.params)
    policy_file.save(out, trained._replace(monitor=monitor), half=half)


def gather(out: str, *folders: str) -> None:
    """Writes the columns of all evaluations in the directories, and their JSON files."""
    arrays = {}
    for folder in map(Path, folders):
        for file in folder.glob("*.json"):
            arrays[file.name] = np.frombuffer(file.read_bytes(), np.uint8)
        for plan in sorted(folder.glob("*/plan.json")):
            for column, values in _columns(plan.parent).items():
                arrays[f"{plan.parent.name}/{column}"] = values
    files.write_npz(Path(out), arrays)


def score(policy: str, file: str, alpha: str = "0.05", windows: str = "1", *names: str) -> None:
    """Calibrates a monitor; writes its figures in the test's trials and under disturbances."""
    arrays = files.read_npz(Path(file))
    trials = read(arrays, int(windows))
    digest = json.loads(arrays["monitor.json"].tobytes())["monitor"]["digest"]
    monitor, strict = (
        calibrated(trials.whole, x, trials.settings, digest, names or scores.CALIBRATED)
        for x in (float(alpha), STRICT)
    )
    write(policy, arrays, trials.labels, monitor, strict)


class Trials(NamedTuple):
    """Gathered trials of a policy.

    Attributes:
      whole: table of the trials with a sampled trocar each.
      labels: tables of the tested trials by disturbance.
      settings: of their scores.
    """

    whole: Any
    labels: dict[str, Any]
    settings: scores.ScoreSettings


def read(arrays: dict[str, np.ndarray], windows: int) -> Trials:
    """Returns the trials of a gathered file, with stillness over several windows."""
    made, stress = (json.loads(arrays[f"{name}.json"].tobytes()) for name in ("monitor", "stress"))
    settings = scores.ScoreSettings(**made["monitor"]["settings"])
    settings = settings._replace(still=settings.still * windows)
    whole = evaluation(arrays, "trials", windows)
    labels = {TESTED: select(whole, calibration.parts(len(whole.success))[2])}
    if "0/success" in arrays:
        labels[UNDISTURBED] = evaluation(arrays, "0", windows)
    for name, kind in stress["disturbances"].items():
        for level in kind["levels"]:
            if float(level):
                label = f"{name} {level} {kind['unit']}".strip()
                labels[label] = evaluation(arrays, f"{name}-{level}", windows)
    return Trials(whole, labels, settings)


def write(
    policy: str,
    arrays: dict[str, np.ndarray],
    labels: dict[str, Any],
    monitor: record.Monitor,
    strict: record.Monitor,
    **more: Any,
) -> None:
    """Writes results/monitor_<POLICY>_gpu.json: both monitors, figures of the tables, and more."""
    made, stress = (json.loads(arrays[f"{name}.json"].tobytes()) for name in ("monitor", "stress"))
    kept = ("version", "commit", "dirty", "versions", "hardware")
    content = {
        "policy": policy,
        "weights": made["weights"],
        "commands": list(dict.fromkeys([made["command"], stress["command"]])),
        **{name: made[name] for name in kept},
        "monitor": record.to_json(monitor),
        "strict": record.to_json(strict),
        **more,
        "rows": {label: figures(table, monitor, strict) for label, table in labels.items()},
    }
    files.write_json(_timing.RESULTS / f"monitor_{policy}_gpu.json", content)


def calibrated(
    table: Any, alpha: float, settings: scores.ScoreSettings, digest: str, names: Sequence[str]
) -> record.Monitor:
    """Calibrates a monitor with the successes of a table, as `starjax calibrate` does."""
    fits, calibrates, _ = calibration.parts(len(table.success))
    parts = [table.scores[table.success & part] for part in (fits, calibrates)]
    return calibration.calibrate(*parts, alpha, settings, digest, names)


def figures(table: Any, monitor: record.Monitor, strict: record.Monitor) -> dict[str, Any]:
    """Returns success, alarms, and the times of alarms on failures, null without one."""
    times, _ = record.first_alarms(monitor, table.scores)
    raised = [round(float(x), 2) if np.isfinite(x) else None for x in times[~table.success]]
    # A trial is lost some control steps after the object left the last tool.
    drop_s = (table.steps - DROPPED_STEPS) / CONTROL_HZ
    let_go = table.lost & jaws_end_open(table)
    others = ~table.success & ~let_go
    few = alarms.compose(table, strict)
    clock = np.nanmax(table.scores[..., scores.NAMES.index("clock")], axis=1)
    return {
        "strict": statistics.rate(table.success),
        "alarms": alarms.compose(table, monitor),
        "before_drop": statistics.rate((times < drop_s)[table.lost]),
        "clock_false_alarms": statistics.rate(clock[table.success] > monitor.clock_s),
        "let_go": statistics.rate(let_go[~table.success]),
        "others_before_clock": statistics.rate((times < monitor.clock_s)[others]),
        "at_strict": {name: few[name] for name in ("before_clock", "false_alarms")},
        "alarm_s": raised,
    }


def jaws_end_open(table: Any) -> np.ndarray:
    """Returns `[M]` True for trials whose jaws were all open at the last decision."""
    closure = table.scores[..., scores.NAMES.index("closure")]
    last = np.isfinite(closure).sum(axis=1) - 1
    return closure[np.arange(len(closure)), last] < -_OPEN


def insert(policy: str) -> None:
    """Puts the monitor of the committed results next to the packaged file."""
    result = files.read_json(_timing.RESULTS / f"monitor_{policy}_gpu.json")
    path = packaged.find("policy", policy)
    files.write_json(policy_file.monitor_path(path), result["monitor"])
    policy_file.load(path)  # raises for a monitor of other weights


def evaluation(arrays: dict[str, np.ndarray], name: str, windows: int = 1) -> Any:
    """Returns the columns of one gathered evaluation, with stillness over several windows."""
    table = SimpleNamespace(**{column: arrays[f"{name}/{column}"] for column in COLUMNS})
    column = scores.NAMES.index("stillness")
    settings = json.loads(arrays["monitor.json"].tobytes())["monitor"]["settings"]
    still, path = settings["still"], table.scores[..., column]
    longer = np.full_like(path, np.nan)
    first = still * (windows - 1)
    parts = [path[:, first - still * k : path.shape[1] - still * k] for k in range(windows)]
    longer[:, first:] = np.sum(parts, axis=0)
    # Trials of the first version lack the last scores.
    values = np.full((*path.shape, len(scores.NAMES)), np.nan, np.float32)
    values[..., : table.scores.shape[-1]] = table.scores
    values[..., column] = longer
    return SimpleNamespace(**{**vars(table), "scores": values})


def select(table: Any, rows: np.ndarray) -> Any:
    """Returns the rows `[M]` bool of a table."""
    return SimpleNamespace(**{name: column[rows] for name, column in vars(table).items()})


def _columns(folder: Path) -> dict[str, np.ndarray]:
    chunks = [files.read_npz(chunk) for chunk in sorted(folder.glob("chunk_*.npz"))]
    return {name: np.concatenate([chunk[name] for chunk in chunks]) for name in COLUMNS}


if __name__ == "__main__":
    commands = {"silent": silent, "gather": gather, "score": score, "insert": insert}
    if len(sys.argv) < 3 or sys.argv[1] not in commands:
        sys.exit(__doc__)
    commands[sys.argv[1]](*sys.argv[2:])
