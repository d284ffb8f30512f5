"""Draws the directions that one grasp serves against the needle's turn, from a result of
`bites.py`.

python experiments/wrist/dial/bites_figure.py results/dial_cpu.json FIGURE.png
"""

import json
import sys
from pathlib import Path
from typing import Any

from starjax.report import style


def main(result: Path, file: Path) -> None:
    found = json.loads(result.read_text())["results"]
    file.write_bytes(style.save(draw(found), "png"))


def draw(found: dict[str, dict[str, Any]]) -> Any:
    """Draws a line per grasp: one for all trocars, for the seen ones, each trocar's own."""
    rows = sorted((int(turn), row) for turn, row in found.items())
    turns = [turn for turn, _ in rows]
    with style.use() as shades:
        figure = style.figure(5.2, 3.2)
        axis = figure.subplots()
        worst = [100 * min(row["by_trocar"]) for _, row in rows]
        best = [100 * max(row["by_trocar"]) for _, row in rows]
        axis.fill_between(turns, worst, best, color=shades["line"], alpha=0.3, lw=0)
        for name, label, colour, marker in (
            ("own_grasp", "a grasp of each trocar's own", shades["muted"], "o"),
            ("one_for_seen", "one for the eight seen trocars", style.SUCCESS, "s"),
            ("one_for_all", "one for all twelve", style.FAILURE, "^"),
        ):
            shares = [100 * row[name] for _, row in rows]
            axis.plot(turns, shares, marker=marker, ms=4, color=colour, label=label)
        axis.set_xlabel("turn of the needle (degrees)")
        axis.set_ylabel("directions served (%)")
        axis.set_ylim(-3, 103)
        style.legend(figure, *axis.get_legend_handles_labels())
    return figure


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:3]))
