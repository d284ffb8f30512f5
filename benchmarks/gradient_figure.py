"""Draws fine-tunings by policy gradient: success, divergence and RCM error by iteration.

python benchmarks/gradient_figure.py FIGURE.png

Reads results/finetune_*.json and results/policy_gradient_*.json whose way is rl.
"""

import sys
from pathlib import Path
from typing import Any

import _timing
import numpy as np
from matplotlib import ticker

from starjax.report import style
from starjax.runtime import files

PANELS = {  # title -> quantity and unit
    "success of new starts": ("success", 1.0),
    "KL divergence": ("kl", 1.0),
    "largest commanded\nRCM error (nm)": ("rcm_commanded_mm", 1e-6),
}
LEAST_KL = 1e-4  # drawn; a first iteration trains the critic alone, with that of rounding


def main(file: Path) -> None:
    """Writes the figure: a panel per quantity, a line per fine-tuning."""
    found = results(_timing.RESULTS)
    with style.use():
        figure = style.figure(9.6, 3.0)
        for axis, (title, (name, unit)) in zip(figure.subplots(1, 3), PANELS.items(), strict=True):
            for label, rows in found.items():
                drawn = [row[name] / unit for row in rows]
                drawn = np.maximum(drawn, LEAST_KL) if name == "kl" else drawn
                axis.plot(range(1, len(rows) + 1), drawn, lw=1.2, label=label)
            axis.set(xlabel="iteration", title=title)
            if name == "kl":
                axis.set_yscale("log")
                axis.yaxis.set_major_formatter(ticker.FormatStrFormatter("%g"))
            if name == "rcm_commanded_mm":
                axis.set_ylim(bottom=0.0)
        figure.axes[-1].legend(fontsize=7, loc="lower right")
        data = style.save(figure, "png")
    file.write_bytes(data)


def results(folder: Path) -> dict[str, list[dict[str, Any]]]:
    """Returns label -> figures of all iterations of all rounds."""
    paths = [*folder.glob("finetune_*.json"), *folder.glob("policy_gradient_*.json")]
    found = {}
    for path in sorted(paths):
        content = files.read_json(path)
        if content["by"] == "rl":
            parts = content.get("rounds", [content])
            label = path.stem.removesuffix("_gpu").split("_", 1)[1]
            found[label] = [row for part in parts for row in part.get("iterations", [])]
    return found


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
