"""Trials with the runtime monitor's scores, of the packaged policies.

    python benchmarks/monitors.py silent POLICY STILL_S OUT.safetensors
    python benchmarks/monitors.py gather OUT.npz CALIBRATION STRESS

`silent` writes a policy whose monitor never raises an alarm: its evaluations record scores before
a calibration has ended. `gather` joins directories of `starjax calibrate` and `starjax stress`: of
every evaluation the columns below, as `<evaluation>/<column>`, and the commands' JSON files.
"""

import sys
from pathlib import Path

import numpy as np

from starjax.evaluation import trials
from starjax.monitor import calibrate, scores
from starjax.policies import packaged, policy_file
from starjax.runtime import files
from starjax.sim.tasks.base import CONTROL_HZ

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


def _columns(folder: Path) -> dict[str, np.ndarray]:
    chunks = [files.read_npz(chunk) for chunk in sorted(folder.glob("chunk_*.npz"))]
    table = trials.join([trials.from_columns(chunk) for chunk in chunks])
    return {name: trials.columns(table)[name] for name in COLUMNS}


if __name__ == "__main__":
    commands = {"silent": silent, "gather": gather}
    if len(sys.argv) < 4 or sys.argv[1] not in commands:
        sys.exit(__doc__)
    commands[sys.argv[1]](*sys.argv[2:])
