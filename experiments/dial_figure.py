"""Draws success along the dial: the study's methods, and the experts, by the needle's turn.

    python experiments/dial_figure.py docs/images/dial_success.png

Columns: seen and unseen trocars, and others that were drawn. Above: the two hierarchies; below: one
model for everything. Bars are 95% intervals.
"""

import json
import sys
from pathlib import Path
from typing import Any

import claims
import columns

from starjax.core.methods import METHODS
from starjax.report import style

HERE = Path(__file__).resolve().parent
RESULTS = HERE.parent / "benchmarks" / "results"
PANELS = {"seen trocars": "seen", "unseen trocars": "unseen", "200 other trocars": "trocars"}
OF_EXPERTS = {"seen": "seen", "unseen": "unseen", "trocars": "others"}
EXPERTS = {
    "default": ("expert, one plane per trocar", "-"),
    "one_plane": ("expert, one plane for all", ":"),
}
SHIFT = 0.5  # degrees between the marks of two lines


def main(file: Path) -> None:
    file.write_bytes(style.save(draw(), "png"))


def draw() -> Any:
    """Draws a line per method, solid with the trocar as input of its generator, else dotted."""
    scored = list(claims.load(HERE / "wrist" / "dial").runs.values())
    kinds = ([x for x in scored if METHODS[_method(x)].hierarchical == up] for up in (True, False))
    rows = list(filter(None, kinds))
    with style.use() as shades:
        figure = style.figure(10.0, 1.0 + 2.7 * len(rows))
        axes = figure.subplots(len(rows), len(PANELS), sharex=True, sharey=True, squeeze=False)
        for row, runs in zip(axes, rows, strict=True):
            for axis, part in zip(row, PANELS.values(), strict=True):
                _experts(axis, OF_EXPERTS[part], shades["ink"])
                for k, run in enumerate(runs):
                    if part == "trocars" and run.swept is None:
                        continue
                    _policy(axis, run, part, SHIFT * (k - (len(runs) - 1) / 2))
            style.percent_axis(row[0])
        for axis, title in zip(axes[0], PANELS, strict=True):
            axis.set_title(title)
        for axis in axes[-1]:
            axis.set_xlabel("turn of the needle (degrees)")
        drawn = [axis.get_legend_handles_labels() for axis in axes[:, 0]]
        named = {label: handle for pair in drawn for handle, label in zip(*pair, strict=True)}
        style.legend(figure, list(named.values()), list(named))
    return figure


def _policy(axis: Any, run: columns.Scored, part: str, shift: float) -> None:
    rates = [columns.by_turn(run, part, turn) for turn in range(len(columns.TURNS))]
    method = _method(run)
    base = method.removesuffix("_told").removesuffix("_untold")
    stroke = "-" if METHODS[method].sees_trocar else ":"
    style.rates(axis, _middles(shift), rates, base, run.run.label, stroke)


def _experts(axis: Any, part: str, colour: str) -> None:
    for name, (label, stroke) in EXPERTS.items():
        turns = json.loads((RESULTS / f"turns_{name}_cpu.json").read_text())["turns"][part]
        rates = [won / of for won, _, of in turns]
        axis.plot(_middles(), rates, stroke, color=colour, lw=1.0, label=label)


def _method(run: columns.Scored) -> str:
    return run.run.result.method


def _middles(shift: float = 0.0) -> list[float]:
    return [low + columns.TURN_WIDTH / 2 + shift for low in columns.TURNS]


if __name__ == "__main__":
    main(Path(sys.argv[1]))
