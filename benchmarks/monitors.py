"""Trials of a calibration and of a stress test in one file, for the runtime monitor's results.

    python benchmarks/monitors.py gather CALIBRATION STRESS OUT.npz

`gather` joins the directories of `starjax calibrate` and `starjax stress`: of every evaluation
the columns below, as `<evaluation>/<column>`, and both commands' JSON files as bytes.
"""

import sys
from pathlib import Path

import numpy as np

from starjax.evaluation import trials
from starjax.runtime import files

COLUMNS = ("success", "lost", "invalid", "steps", "scores")
FILES = ("monitor.json", "stress.json")


def gather(calibration: Path, stress: Path, out: Path) -> None:
    """Writes the columns of all evaluations in two directories, and their JSON files."""
    arrays = {}
    for name, folder in zip(FILES, (calibration, stress), strict=True):
        arrays[name] = np.frombuffer((folder / name).read_bytes(), np.uint8)
        for plan in sorted(folder.glob("*/plan.json")):
            for column, values in _columns(plan.parent).items():
                arrays[f"{plan.parent.name}/{column}"] = values
    files.write_npz(out, arrays)


def _columns(folder: Path) -> dict[str, np.ndarray]:
    chunks = [files.read_npz(chunk) for chunk in sorted(folder.glob("chunk_*.npz"))]
    table = trials.join([trials.from_columns(chunk) for chunk in chunks])
    return {name: trials.columns(table)[name] for name in COLUMNS}


if __name__ == "__main__":
    if len(sys.argv) != 5 or sys.argv[1] != "gather":
        sys.exit(__doc__)
    gather(*map(Path, sys.argv[2:]))
