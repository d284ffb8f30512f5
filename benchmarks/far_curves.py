"""Draws success, late plans and holding over the delay, from results of `far_robots.py`.

python benchmarks/far_curves.py FOLDER FIGURE.png
"""

import sys
from pathlib import Path
from typing import Any

import numpy as np

from starjax.evaluation import result, statistics
from starjax.report import style


def main(folder: Path, file: Path) -> None:
    found = [result.read(path) for path in folder.glob("*.json")]
    steady = [one for one in found if is_steady(one.about.get("served"))]
    steady.sort(key=delay_ms)
    file.write_bytes(style.save(draw(steady), "png"))


def is_steady(served: dict[str, Any] | None) -> bool:
    """True for a delay alone."""
    if served is None:
        return False
    network = served["network"]
    return not (network["jitter_s"] or network["drop"] or network["kills_s"])


def delay_ms(one: result.Result) -> float:
    return 1e3 * one.about["served"]["network"]["delay_s"]


def draw(steady: list[result.Result]) -> Any:
    """Two panels; a point is a delay."""
    delays = [delay_ms(one) for one in steady]
    rates = np.array([np.mean([t.success for t in one.trials]) for one in steady])
    bounds = [statistics.wilson(sum(t.success for t in x.trials), len(x.trials)) for x in steady]
    with style.use() as shades:
        figure = style.figure(7.4, 2.8)
        left, right = figure.subplots(1, 2)
        low, high = np.array(bounds).T
        left.errorbar(
            delays, rates, [rates - low, high - rates], marker="o", color=style.SUCCESS, capsize=2
        )
        left.set_title("success, 95% Wilson interval")
        style.percent_axis(left)
        for part, whole, label, colour in (
            ("missed", "plans", "plans that came late", style.FAILURE),
            ("held", "steps", "control steps held", shades["muted"]),
        ):
            served = [one.about["served"] for one in steady]
            shares = [said[part] / said[whole] for said in served]
            right.plot(delays, shares, marker="o", color=colour, label=label)
        right.set_title("deadlines")
        style.percent_axis(right)
        right.legend()
        for axes in (left, right):
            axes.set_xlabel("from a question to its answer (ms)")
    return figure


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:3]))
