"""Draws how far the trocar moves the expert's wanted tip in each phase, from a result of
`proposition.py`.

python experiments/methods/proposition_figure.py results/proposition_cpu.json FIGURE.png
"""

import json
import sys
from pathlib import Path
from typing import Any

from starjax.report import style

COLUMNS = 3
LEAST = 0.005  # digits of the shares that are written
OF_TWO = {"arm0": "gives", "arm1": "takes over"}


def main(result: Path, file: Path) -> None:
    found = json.loads(result.read_text())["results"]
    panels = [
        (f"{task}: {OF_TWO[name]}" if len(row["arms"]) > 1 else task, arm["phases"])
        for task, row in sorted(found.items(), key=_order)
        for name, arm in row["arms"].items()
    ]
    file.write_bytes(style.save(draw(panels), "png"))


def _order(item: tuple[str, Any]) -> float:
    return max(arm["share"] for arm in item[1]["arms"].values())


def draw(panels: list[tuple[str, dict[str, Any]]]) -> Any:
    """A panel a tip: two bars a phase, and above them the percentage that the trocar explains."""
    rows = -(-len(panels) // COLUMNS)
    with style.use() as shades:
        figure = style.figure(9.0, 2.3 * rows + 0.4)
        axes = figure.subplots(rows, COLUMNS, squeeze=False).ravel()
        for axis in axes[len(panels) :]:
            axis.set_visible(False)
        for axis, (title, phases) in zip(axes, panels, strict=False):
            places = range(len(phases))
            scenes = [phase["scene_mm"] for phase in phases.values()]
            trocar = [phase["trocar_mm"] for phase in phases.values()]
            left, right = ([x + aside for x in places] for aside in (-0.2, 0.2))
            axis.bar(left, scenes, 0.4, color=shades["line"], label="scenes move it")
            axis.bar(
                right,
                trocar,
                0.4,
                color=style.FAILURE,
                label="the trocar moves it; percent of the variance",
            )
            for x, height, phase in zip(right, trocar, phases.values(), strict=True):
                text = f"{100 * phase['share']:.0f}" if phase["share"] >= LEAST else ""
                axis.annotate(text, (x, height), ha="center", va="bottom", fontsize=6.5)
            axis.set_title(title)
            axis.set_xticks(list(places), list(phases), rotation=45, ha="right", fontsize=7)
            axis.grid(False, axis="x")
        for axis in axes[::COLUMNS]:
            axis.set_ylabel("RMS (mm)")
        style.legend(figure, *axes[0].get_legend_handles_labels())
    return figure


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:3]))
