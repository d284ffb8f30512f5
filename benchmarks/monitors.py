"""Runtime monitors of the packaged policies: their trials, their results, their place in the files.

    python benchmarks/monitors.py silent POLICY STILL_S OUT.safetensors
    python benchmarks/monitors.py gather OUT.npz CALIBRATION STRESS
    python benchmarks/monitors.py score POLICY TRIALS.npz
    python benchmarks/monitors.py insert POLICY

`silent` writes a policy whose monitor never raises an alarm: its evaluations record scores before
a calibration has ended. `gather` joins directories of `starjax calibrate` and `starjax stress`: of
every evaluation the columns below, as `<evaluation>/<column>`, and the commands' JSON files.
`score` calibrates a monitor from such a file and writes results/monitor_<POLICY>_gpu.json; `insert`
puts the monitor of these results into the packaged file. Neither needs a GPU.
"""

import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import _timing
import numpy as np

from starjax.evaluation import alarms, statistics
from starjax.monitor import calibrate, scores
from starjax.policies import packaged, policy_file
from starjax.runtime import files
from starjax.sim.tasks.base import CONTROL_HZ
from starjax.sim.tasks.peg_transfer_bimanual.task import DROPPED_STEPS

COLUMNS = ("success", "lost", "invalid", "steps", "scores")
_NEVER = 1e9  # a threshold beyond any score


def silent(policy: str, still_s: str, out: str) -> None:
    """Writes a policy with a monitor that never raises an alarm."""
    trained = policy_file.load(packaged.find("policy", policy))
    execute = trained.policy.execute
    still = max(1, round(float(still_s) * CONTROL_HZ / execute))
    monitor = calibrate.Monitor(
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


def score(policy: str, file: str) -> None:
    """Calibrates a monitor; writes its figures in the test's trials and under disturbances."""
    arrays = files.read_npz(Path(file))
    made, stress = (json.loads(arrays[f"{name}.json"].tobytes()) for name in ("monitor", "stress"))
    whole = evaluation(arrays, "trials")
    monitor, fewer = (calibrated(x, made["monitor"]) for x in (whole, without_closure(whole)))
    tests = calibrate.parts(len(whole.success))[2]
    labels = {"nothing, trocars of the test": SimpleNamespace(**_at(whole, tests))}
    labels["nothing, the task's trocars"] = evaluation(arrays, "0")
    for name, kind in stress["disturbances"].items():
        for level in kind["levels"]:
            if float(level):
                label = f"{name} {level} {kind['unit']}".strip()
                labels[label] = evaluation(arrays, f"{name}-{level}")
    rows = {label: figures(table, monitor, fewer) for label, table in labels.items()}
    kept = ("version", "commit", "dirty", "versions", "hardware")
    content = {
        "policy": policy,
        "weights": made["weights"],
        "commands": [made["command"], stress["command"]],
        **{name: made[name] for name in kept},
        "monitor": calibrate.to_json(monitor),
        "rows": rows,
    }
    files.write_json(_timing.RESULTS / f"monitor_{policy}_gpu.json", content)


def calibrated(table: Any, made: dict[str, Any]) -> calibrate.Monitor:
    """Calibrates a monitor with the successes of a table, as `starjax calibrate` does."""
    fits, calibrates, _ = calibrate.parts(len(table.success))
    settings = scores.ScoreSettings(**made["settings"])
    parts = [table.scores[table.success & part] for part in (fits, calibrates)]
    return calibrate.calibrate(*parts, made["alpha"], settings, made["digest"])


def without_closure(table: Any) -> Any:
    """Returns the table with this score undefined."""
    values = table.scores.copy()
    values[..., scores.NAMES.index("closure")] = np.nan
    return SimpleNamespace(**{**vars(table), "scores": values})


def figures(table: Any, monitor: calibrate.Monitor, fewer: calibrate.Monitor) -> dict[str, Any]:
    """Returns success, alarms, and the times of alarms on failures, null without one."""
    times, _ = calibrate.first_alarms(monitor, table.scores)
    raised = [round(float(x), 2) if np.isfinite(x) else None for x in times[~table.success]]
    # A trial is lost some control steps after the object left the last tool.
    drop_s = (table.steps - DROPPED_STEPS) / CONTROL_HZ
    less = alarms.compose(without_closure(table), fewer)
    return {
        "strict": statistics.rate(table.success),
        "alarms": alarms.compose(table, monitor),
        "before_drop": statistics.rate((times < drop_s)[table.lost]),
        "without_closure": {name: less[name] for name in ("before_clock", "false_alarms")},
        "alarm_s": raised,
    }


def insert(policy: str) -> None:
    """Puts the monitor of the committed results into the packaged file."""
    result = files.read_json(_timing.RESULTS / f"monitor_{policy}_gpu.json")
    path = packaged.find("policy", policy)
    trained = policy_file.load(path)
    monitor = calibrate.from_json(result["monitor"])
    half = policy_file.is_half(trained.params)
    policy_file.save(path, trained._replace(monitor=monitor), half=half)


def evaluation(arrays: dict[str, np.ndarray], name: str) -> Any:
    """Returns the columns of one gathered evaluation."""
    return SimpleNamespace(**{column: arrays[f"{name}/{column}"] for column in COLUMNS})


def _at(table: Any, rows: np.ndarray) -> dict[str, np.ndarray]:
    return {name: column[rows] for name, column in vars(table).items()}


def _columns(folder: Path) -> dict[str, np.ndarray]:
    chunks = [files.read_npz(chunk) for chunk in sorted(folder.glob("chunk_*.npz"))]
    return {name: np.concatenate([chunk[name] for chunk in chunks]) for name in COLUMNS}


if __name__ == "__main__":
    commands = {"silent": silent, "gather": gather, "score": score, "insert": insert}
    if len(sys.argv) < 3 or sys.argv[1] not in commands:
        sys.exit(__doc__)
    commands[sys.argv[1]](*sys.argv[2:])
