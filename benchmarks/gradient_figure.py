"""Draws fine-tunings by policy gradient: success, divergence and RCM error by iteration.

python benchmarks/gradient_figure.py FIGURE.png

Reads results/finetune_*.json and results/policy_gradient_*.json whose way is rl.
"""

import itertools
import sys
from pathlib import Path
from typing import Any

import _timing
import finetuned
import numpy as np
from matplotlib import ticker

from starjax.report import style
from starjax.runtime import files

PANELS = {  # title -> quantity and unit
    "success (%): new starts with noise,\npoints: validation without": ("success", 0.01),
    "KL divergence": ("kl", 1.0),
    "largest commanded\nRCM error (nm)": ("rcm_commanded_mm", 1e-6),
}
LEAST_KL = 1e-4  # drawn; a first iteration trains the critic alone, with that of rounding
COLOURS = ("#009E73", "#2083C5", "#CC79A7", "#8C6D4F")


def main(file: Path) -> None:
    """Writes the figure: a panel per quantity, a line per fine-tuning, points of validation."""
    found = results()
    with style.use():
        figure = style.figure(9.6, 3.0)
        for axis, (title, (name, unit)) in zip(figure.subplots(1, 3), PANELS.items(), strict=True):
            for (label, rounds), colour in zip(found.items(), COLOURS, strict=False):
                rows = [row for part in rounds for row in part.get("iterations", [])]
                drawn = [row[name] / unit for row in rows]
                drawn = np.maximum(drawn, LEAST_KL) if name == "kl" else drawn
                steps = range(1, len(rows) + 1)
                axis.plot(steps, drawn, lw=1.2, color=colour, label=label)
                if name == "success":
                    axis.plot(*validations(rounds), "o", ms=4, color=colour)
            axis.set(xlabel="iteration", title=title)
            if name == "kl":
                axis.set_yscale("log")
                axis.yaxis.set_major_formatter(ticker.FormatStrFormatter("%g"))
            if name == "rcm_commanded_mm":
                axis.set_ylim(bottom=0.0)
        figure.axes[-1].legend(fontsize=7, loc="lower right")
        data = style.save(figure, "png")
    file.write_bytes(data)


def validations(rounds: list[dict[str, Any]]) -> tuple[list[int], list[float]]:
    """Returns the iterations before each validation, and its success in percent."""
    counts = itertools.accumulate(len(part.get("iterations", [])) for part in rounds)
    points = [
        (count, 100 * part["validation"]["rate"])
        for count, part in zip(counts, rounds, strict=True)
        if "validation" in part
    ]
    return [count for count, _ in points], [rate for _, rate in points]


def results() -> dict[str, list[dict[str, Any]]]:
    """Returns task and commit -> all rounds."""
    first = [files.read_json(path) for path in _timing.RESULTS.glob("policy_gradient_*.json")]
    return {
        f"{found['task'].replace('_', ' ')}, {found['commit'][:8]}": found.get("rounds", [found])
        for found in [*finetuned.finetunings(), *first]
        if found["by"] == "rl"
    }


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
