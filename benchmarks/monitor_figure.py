"""Draws the fraction of failures that the packaged policies' monitors announced, by time.

python benchmarks/monitor_figure.py FIGURE.png
"""

import sys
from pathlib import Path
from typing import Any

import _timing
import numpy as np

from starjax.report import style
from starjax.runtime import files

POLICIES = ("compact", "needle_pick", "peg_transfer_bimanual", "peg_transfer_robust")
LEAST = 20  # failures of a drawn line
UNTIL_S = 24.0


def main(file: Path) -> None:
    """Writes the figure: a panel per policy, a line per disturbance, the clock dashed."""
    with style.use():
        figure = style.figure(9.6, 7.8)
        for axis, policy in zip(figure.subplots(2, 2).ravel(), POLICIES, strict=True):
            draw(axis, files.read_json(_timing.RESULTS / f"monitor_{policy}_gpu.json"))
        data = style.save(figure, "png")
    file.write_bytes(data)


def draw(axis: Any, found: dict[str, Any]) -> None:
    """Draws one policy."""
    for label, row in found["rows"].items():
        count = len(row["alarm_s"])
        if count < LEAST:
            continue
        times = np.sort([time for time in row["alarm_s"] if time is not None])
        announced = np.arange(len(times) + 1) / count
        x = np.concatenate([[0.0], times, [UNTIL_S]])
        axis.step(x, [*announced, announced[-1]], where="post", lw=1.2, label=f"{label} ({count})")
    clock_s = found["monitor"]["clock_s"]
    axis.axvline(clock_s, color="black", lw=1.0, ls="--", label=f"clock alone, {clock_s:.1f} s")
    axis.set(xlim=(0, UNTIL_S), ylim=(0, 1.02), title=found["policy"])
    axis.set(xlabel="time of the first alarm (s)", ylabel="failures announced")
    axis.legend(fontsize=6.5, loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
